"""The response map of a policy with a dial: measured in flight, monotone, inverted, kept with the policy."""

import dataclasses
import itertools

import numpy as np
import pytest

from flytune.control.policy import load_policy, save_policy
from flytune.control.response_map import ResponseMap, monotone, response_map
from flytune.errors import BadInput
from flytune.evaluation.measure_map import measure_map, with_maps
from flytune.runs.find import find_controller
from flytune.task.files import load_task

FAMILY = load_task("dial")


def the_policy():
    """The policy that ships."""
    return find_controller("dial").controller


def a_map(values, times, settled=None):
    """A map with given settling times."""
    count = len(values)
    spread = [{"median": time, "low": time, "high": time} for time in times]
    return ResponseMap(
        dial="speed", unit="m/s", trials=100, seed=1, values=values, settled=settled or [100] * count,
        settling_time=spread, overshoot=[0.0] * count, steady_state_error=spread, peak_speed=spread,
        monotone=monotone(times),
    )  # fmt: skip


@pytest.mark.slow
def test_the_map_that_ships_was_measured_with_the_policy_that_ships():
    carried = response_map(the_policy())
    assert carried is not None
    again = measure_map(the_policy(), FAMILY, settings=2, trials=carried.trials)  # the two ends, flown again
    for index, time in zip((0, -1), again.settling_time, strict=True):
        assert time["median"] == pytest.approx(carried.settling_time[index]["median"], rel=0.01)
    assert carried.settled == [carried.trials] * 20
    assert [time["low"] <= time["median"] <= time["high"] for time in carried.settling_time] == [True] * 20


def test_the_map_falls_strictly_and_its_inverse_gives_the_setting_back():
    carried = response_map(the_policy())
    assert carried is not None
    times = [time["median"] for time in carried.settling_time]
    assert all(slow > fast for slow, fast in itertools.pairwise(times))
    for value, time in zip(carried.values, times, strict=True):
        assert carried.setting_for(time) == pytest.approx(value, rel=1e-6)
        assert carried.covers(time)
    assert -1.0 < carried.slope() < -0.5
    assert not carried.covers(0.5 * times[-1])
    # beyond its ends, the map answers with its ends
    assert carried.setting_for(1000.0) == pytest.approx(0.2)
    assert carried.setting_for(0.1) == pytest.approx(1.6)


def test_between_two_settings_the_curve_is_a_line_in_the_logarithms():
    known = a_map([0.2, 0.8, 1.6], [8.0, 2.0, 1.0])  # settling time = 1.6 / value
    for value in (0.2, 0.3, 0.5, 1.0, 1.6):
        assert known.setting_for(1.6 / value) == pytest.approx(value)
    assert known.slope() == pytest.approx(-1.0)


def test_a_dial_with_a_value_of_zero_has_a_line_in_the_value():
    known = a_map([0.0, 0.5, 1.0], [4.0, 2.0, 1.0])  # settling time = 4 * 4^-value
    for value in (0.0, 0.25, 0.5, 0.8, 1.0):
        assert known.setting_for(4.0 * 4.0**-value) == pytest.approx(value)


def test_neighbours_in_the_wrong_order_are_pooled():
    # 3 and 4 rise where the curve falls: both become their geometric mean, sqrt(12)
    assert monotone([8.0, 3.0, 4.0, 2.0]) == pytest.approx([8.0, 12**0.5, 12**0.5, 2.0])
    assert monotone([1.0, 2.0, 3.0]) == pytest.approx([1.0, 2.0, 3.0])
    assert monotone([1.0, None, 0.5]) == [1.0, None, 0.5]
    known = a_map([0.2, 0.4, 0.8, 1.6], [8.0, 3.0, 4.0, 2.0])
    settings = [known.setting_for(time) for time in np.geomspace(2.0, 8.0, 50)]
    assert all(slow >= fast - 1e-9 for slow, fast in itertools.pairwise(settings))


def test_a_setting_that_does_not_settle_gives_no_answer():
    known = a_map([0.2, 0.4, 0.8], [None, 4.0, 2.0])
    assert known.setting_for(100.0) == pytest.approx(0.4)
    with pytest.raises(BadInput, match="fewer than two settings settle"):
        a_map([0.2, 0.4], [None, 4.0]).setting_for(3.0)


def test_a_map_is_kept_with_its_policy(tmp_path):
    family = load_task("dial", {"dial.speed.lowest": 0.7, "dial.speed.highest": 0.9})
    policy = dataclasses.replace(the_policy(), dials=family.dial, maps={})
    assert response_map(policy) is None
    measured = dataclasses.replace(policy, maps={"speed": measure_map(policy, family, settings=2, trials=10).to_dict()})
    save_policy(tmp_path / "policy.safetensors", measured)
    read = response_map(load_policy(tmp_path / "policy.safetensors"))
    assert read == response_map(measured)
    assert read is not None
    assert "0.700" in read.table()
    assert with_maps(find_controller("baseline-refined").controller, family).maps == {}


@pytest.mark.parametrize("damage", [{}, {"dial": "speed"}, {"values": 3}, {"monotone": None}, {"monotone": ["a", "b"]}])
def test_a_damaged_map_is_refused(damage):
    good = a_map([0.2, 0.8], [8.0, 2.0]).to_dict()
    data = {**good, **damage} if damage and len(damage) == 1 and "dial" not in damage else damage
    with pytest.raises(BadInput, match="map"):
        ResponseMap.read(data)


def test_a_policy_without_this_dial_has_no_map():
    with pytest.raises(BadInput, match=r"'pace' is no dial of this policy\. Allowed: speed"):
        measure_map(the_policy(), FAMILY, "pace")
    with pytest.raises(BadInput, match="Allowed: none"):
        measure_map(find_controller("baseline-refined").controller, FAMILY)
