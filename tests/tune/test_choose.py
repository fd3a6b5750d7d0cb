"""The choice of the next edit, on responses made up for it: by rule, by what was flown, by what was measured."""

import dataclasses
import math

import pytest

from flytune import document
from flytune.task.task import load_task
from flytune.tune.choose import HALF_WAY, Step, choose
from flytune.tune.effects import load_effects
from flytune.tune.requirement import Measured, make_requirement
from flytune.tune.rules import load_rules

TABLES = document.plain(load_task("baseline-refined"))
SPEED = "termination.speed.bound"
GOOD = Measured(settling_time=2.0, overshoot=0.0, error=0.001, settled=1.0, kept=1.0)
KNOWN = load_effects()
UNKNOWN = dataclasses.replace(KNOWN, knobs={})
RULES = load_rules()


def step(number=0, values=None, edit=None, origin=None, **measured):
    return Step(
        number=number,
        values=values or {},
        reasons=dict.fromkeys(values or {}, "so"),
        edit=edit,
        origin=origin,
        measured=dataclasses.replace(GOOD, **measured),
        seconds=1.0,
    )


def chosen(steps, wanted, fixed=(), effects=UNKNOWN, rules=RULES):
    found = choose(steps, TABLES, wanted, rules, effects, fixed)
    assert not isinstance(found, list), found
    return found


def after(steps, wanted, **measured):
    """The steps, and one more that took the next edit and flies as said."""
    origin, edit = chosen(steps, wanted)
    values = {**origin.values, edit.field: edit.after}
    return [*steps, step(len(steps), values, edit, origin.number, **measured)]


@pytest.mark.parametrize(("time", "name", "way"), [(4.0, "H7 faster", 1), (1.0, "H7 slower", -1)])
def test_a_response_that_is_off_in_time_moves_the_speed_bound(time, name, way):
    _, edit = chosen([step(settling_time=time)], make_requirement(2))
    assert (edit.rule, edit.field, edit.before) == (name, SPEED, 0.8)
    assert (edit.after - edit.before) * way > 0
    # slope -0.8: to halve the time the bound is multiplied by 2^(1/0.8)
    assert edit.after == pytest.approx(0.8 * 2 ** (way / 0.8), rel=0.01)
    assert edit.expects == pytest.approx(2.0, rel=0.01)


def test_the_second_edit_follows_the_slope_of_the_first():
    wanted = make_requirement(2)
    steps = after([step(settling_time=4.0)], wanted, settling_time=2.5)
    first = steps[1].edit
    slope = math.log(2.5 / 4) / math.log(first.after / first.before)
    _, edit = chosen(steps, wanted)
    assert edit.known_from == "flown"
    assert math.log(edit.after / first.after) == pytest.approx(math.log(2 / 2.5) / slope, rel=0.02)


def test_between_a_faster_and_a_slower_step_the_bound_is_interpolated():
    wanted = make_requirement(2)
    steps = after([step(settling_time=4.0)], wanted, settling_time=1.5)
    _, edit = chosen(steps, wanted)
    share = math.log(2 / 1.5) / math.log(4 / 1.5)
    assert edit.after == pytest.approx(steps[1].edit.after * (0.8 / steps[1].edit.after) ** share, rel=0.01)


def test_what_the_user_has_fixed_is_not_touched():
    wanted = make_requirement(2)
    _, edit = chosen([step(settling_time=4.0)], wanted, fixed=(SPEED,))
    assert edit.field != SPEED
    _, edit = chosen([step(settling_time=4.0)], wanted, fixed=("termination",))
    assert not edit.field.startswith("termination.")


def test_where_every_field_is_fixed_each_rule_says_so():
    found = choose([step(settling_time=4.0)], TABLES, make_requirement(2), RULES, UNKNOWN, ("termination", "reward"))
    assert isinstance(found, list)
    assert found
    assert all(line.endswith("is set by the user") for line in found)


def test_a_rule_that_did_not_help_is_not_used_again():
    wanted = make_requirement(2)
    steps = after([step(settling_time=4.0)], wanted, settling_time=4.0)
    _, edit = chosen(steps, wanted)
    assert edit.rule != steps[1].edit.rule


def test_a_rule_stops_at_the_end_of_its_range():
    rules = [dataclasses.replace(rule, range=(0.05, 0.8)) if rule.field == SPEED else rule for rule in RULES]
    _, edit = chosen([step(settling_time=4.0)], make_requirement(2), rules=rules)
    assert edit.field != SPEED


def test_an_edit_that_loses_the_trials_is_taken_back_half_way():
    wanted = make_requirement(2)
    steps = after([step(settling_time=4.0)], wanted, settling_time=math.inf, settled=0.3)
    origin, edit = chosen(steps, wanted)
    assert (origin.number, edit.rule, edit.field) == (0, HALF_WAY, SPEED)
    assert edit.after == pytest.approx(math.sqrt(0.8 * steps[1].edit.after), rel=0.01)


@pytest.mark.parametrize(
    ("measured", "condition"),
    [({"overshoot": 0.2}, "overshoots"), ({"error": 0.015}, "inexact"), ({"settled": 0.9}, "unsettled")],
)
def test_each_thing_that_is_missing_has_its_rules(measured, condition):
    _, edit = chosen([step(**measured)], make_requirement(2))
    assert edit.condition == condition


def test_a_rule_does_not_cost_what_it_spares():
    # with overshoot, H6 must not take weight from the velocity term to be faster
    steps = [step(settling_time=4.0, overshoot=0.2)]
    only = [rule for rule in RULES if rule.name == "H6 faster"]
    found = choose(steps, TABLES, make_requirement(2), only, UNKNOWN, ())
    assert found == ["too slow: H6 faster: forbidden while overshoot is missed"]


def test_a_rule_that_was_measured_to_do_the_opposite_is_not_used():
    curve = KNOWN.knobs[SPEED]
    upside_down = dataclasses.replace(KNOWN, knobs={"reward.velocity.weight": curve})  # up is faster there
    rules = [rule for rule in RULES if rule.name == "H6 faster"]
    found = choose([step(settling_time=4.0)], TABLES, make_requirement(2), rules, upside_down, ())
    assert found == ["too slow: H6 faster: measured to have the opposite effect there"]


def test_the_effect_map_says_how_far_to_go():
    _, edit = chosen([step(settling_time=4.0)], make_requirement(2), effects=KNOWN)
    assert (edit.field, edit.known_from) == (SPEED, "map")
    slope = KNOWN.elasticity(SPEED, "settling_time", 0.8)
    assert edit.after == pytest.approx(min(2.4, 0.8 * math.exp(math.log(0.5) / slope)), rel=0.01)
