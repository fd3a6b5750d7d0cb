"""C1: where standing still pays, against flights written out step by step."""

import dataclasses

import numpy as np
import pytest

from flytune.reproduction.standstill import standstill_distance
from flytune.task.files import load_task


def horizontal(r):
    return 0.25 * (0.6 * np.exp(-4 * r**2) + 0.4 * np.exp(-150 * r**2))  # paper R13


def motion(v):
    return 0.15 * np.exp(-1.5 * v**2)


def worth_of_flying(start, discount, speed=0.2):
    """Discounted reward of flying straight at the bound, then resting on the target for good."""
    steps = round(start / (speed * 0.01))
    distance = start - speed * 0.01 * np.arange(steps)
    on_the_way = np.sum(discount ** np.arange(steps) * (horizontal(distance) + motion(speed)))
    return on_the_way + discount**steps * (horizontal(0.0) + motion(0.0)) / (1 - discount)


def worth_of_staying(start, discount):
    return (horizontal(start) + motion(0.0)) / (1 - discount)


@pytest.mark.parametrize("discount", [0.99, 0.995])
def test_beyond_the_distance_the_fastest_flight_earns_less_than_staying(discount):
    limit = standstill_distance(load_task("inspection"), discount)
    assert limit is not None
    for further in (0.02, 0.3, 0.8):
        assert worth_of_flying(limit + further, discount) < worth_of_staying(limit + further, discount)
    # the fastest flight is one way to fly: a little nearer it need not pay yet, well inside it does
    assert worth_of_flying(limit - 0.15, discount) > worth_of_staying(limit - 0.15, discount)


def test_with_a_discount_near_one_flying_earns_most_from_everywhere():
    assert standstill_distance(load_task("inspection"), 0.999) is None
    assert standstill_distance(load_task("baseline"), 0.995) is None


def test_a_wider_reward_reaches_further():
    task = load_task("inspection")
    wider = dataclasses.replace(
        task, reward={**task.reward, "horizontal": dataclasses.replace(task.reward["horizontal"], wide=1.0)}
    )
    near, far = (standstill_distance(each, 0.99) for each in (task, wider))
    assert near is not None and far is not None
    assert far > near + 0.3
