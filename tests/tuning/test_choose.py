"""The choice of the next edit, on responses made up for it: by rule, by what was flown, by what was measured."""

import dataclasses
import json
import math

import pytest

from flytune.config import document
from flytune.task.task import load_task
from flytune.tuning.choose import choose
from flytune.tuning.iteration import HALF_WAY, Step
from flytune.tuning.requirement import Measured, make_requirement
from flytune.tuning.rules import load_rules
from flytune.tuning.sensitivity import load_effects

TABLES = document.plain(load_task("baseline-refined"))
SPEED = "termination.speed.bound"
GOOD = Measured(settling_time=2.0, overshoot=0.0, error=0.001, settled=1.0, kept=1.0)
KNOWN = load_effects()
UNKNOWN = dataclasses.replace(KNOWN, parameters={})
RULES = load_rules()


def step(number=0, values=None, edit=None, origin=None, **measured):
    return Step(
        number=number,
        values=values or {},
        reasons=dict.fromkeys(values or {}, "so"),
        edit=edit,
        origin=origin,
        measured=dataclasses.replace(GOOD, **measured),
        looks=1,
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


def test_a_curve_that_bends_is_not_followed_in_ever_smaller_steps():
    # the time hardly depends on the bound but at its lower end, where it grows to ten times
    def flown(bound):
        return 1.9 + 18 * math.exp(-40 * (bound - 0.3))

    wanted = make_requirement(3, tolerance=5)
    only = [rule for rule in RULES if rule.field == SPEED]
    steps = [step(settling_time=flown(0.8)), step(1, {SPEED: 0.3}, None, 0, settling_time=flown(0.3))]
    while wanted.misses(steps[-1].measured):
        origin, edit = chosen(steps, wanted, rules=only)
        values = {SPEED: edit.after}
        steps = [*steps, step(len(steps), values, edit, origin.number, settling_time=flown(edit.after))]
    assert len(steps) <= 8  # without it, 12


def test_a_knob_with_a_threshold_is_tried_again_beyond_it():
    # the map knows that the velocity weight slows beyond 0.2; that 0.1 to 0.2 did little does not end it
    wanted = make_requirement(5)
    only = [rule for rule in RULES if rule.field == "reward.velocity.weight"]
    _, edit = chosen([step(settling_time=3.0)], wanted, effects=KNOWN, rules=only)
    steps = [step(settling_time=3.0), step(1, {edit.field: edit.after}, edit, 0, settling_time=3.05)]
    origin, again = chosen(steps, wanted, effects=KNOWN, rules=only)
    assert (origin.number, again.before, again.known_from) == (1, edit.after, "map")


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
    assert found[0].startswith("too slow: H7 faster (termination.speed.bound is set by the user), ")
    assert found[0].count("is set by the user") == len([rule for rule in RULES if rule.when == "too slow"])


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
    assert found == ["too slow: H6 faster (not while the overshoot is missed)"]


def test_a_rule_that_was_measured_to_do_the_opposite_is_not_used():
    curve = KNOWN.parameters[SPEED]
    upside_down = dataclasses.replace(KNOWN, parameters={"reward.velocity.weight": curve})  # up is faster there
    rules = [rule for rule in RULES if rule.name == "H6 faster"]
    found = choose([step(settling_time=4.0)], TABLES, make_requirement(2), rules, upside_down, ())
    assert found == ["too slow: H6 faster (measured to have the opposite effect there)"]


def test_the_effect_map_says_how_far_to_go():
    _, edit = chosen([step(settling_time=4.0)], make_requirement(2), effects=KNOWN)
    assert (edit.field, edit.known_from) == (SPEED, "map")
    slope = KNOWN.elasticity(SPEED, "settling_time", 0.8)
    assert edit.after == pytest.approx(min(2.4, 0.8 * math.exp(math.log(0.5) / slope)), rel=0.01)


def test_no_edit_is_made_twice():
    # two steps bracket the target, and every step near the target loses trials
    wanted = make_requirement(2, tolerance=2)
    only = [rule for rule in RULES if rule.field == SPEED]
    steps = after([step(settling_time=2.5)], wanted, settling_time=1.7)
    for _ in range(20):
        found = choose(steps, TABLES, wanted, only, UNKNOWN, ())
        if isinstance(found, list):
            break
        origin, edit = found
        flown = [each.values.get(SPEED, 0.8) for each in steps]
        assert all(abs(math.log(edit.after / value)) >= 0.01 for value in flown)
        steps = [*steps, step(len(steps), {SPEED: edit.after}, edit, origin.number, settling_time=2.0, settled=0.95)]
    assert 3 <= len(steps) < 20


def test_of_all_steps_the_one_is_gone_on_from_that_is_expected_to_come_nearest():
    # step 1 overshot the settling time wildly; step 0 is far nearer
    wanted = make_requirement(2)
    steps = after([step(settling_time=2.3)], wanted, settling_time=0.4)
    origin, edit = chosen(steps, wanted)
    assert origin.number == 0
    assert edit.known_from == "between"


def test_a_setting_of_another_trainer_is_left_alone():
    lame = [step(settled=0.9)]
    longer = [rule for rule in RULES if rule.field in ("apg.updates", "ppo.steps")]
    for trainer, field in (("apg", "apg.updates"), ("ppo", "ppo.steps")):
        found = choose(lame, TABLES, make_requirement(2), longer, KNOWN, (), trainer=trainer)
        assert not isinstance(found, list)
        assert found[1].field == field


def test_a_knob_the_map_saw_move_nothing_is_used_by_ppo_alone():
    only = [rule for rule in RULES if rule.name == "H1 bolder"]
    found = choose([step(settling_time=4.0)], TABLES, make_requirement(2), only, KNOWN, ())
    assert found == ["too slow: H1 bolder (measured to move nothing)"]
    bolder = [dataclasses.replace(rule, slope=-0.5) for rule in only]
    found = choose([step(settling_time=4.0)], TABLES, make_requirement(2), bolder, KNOWN, (), trainer="ppo")
    assert not isinstance(found, list)
    assert found[1].known_from == "rule"


def test_each_axis_has_a_knob_of_its_own():
    fixed = (SPEED,)
    _, edit = chosen([step(settling_time=1.4)], make_requirement(1.0, axis="z"), fixed, KNOWN)
    assert edit.field == "reward.vertical.sharpness"
    _, edit = chosen([step(settling_time=0.3)], make_requirement(0.6, axis="yaw"), (), KNOWN)
    assert edit.field == "termination.body_rate.bound_deg_per_s"


def test_an_edit_that_would_break_another_requirement_is_worth_less():
    # by the map a rate bound of 230 deg/s instead of 530 makes the position slower, and overshoot by 1.7 %
    only = [rule for rule in RULES if rule.name == "H9 slower turns"]
    steps = [step(settling_time=2.86)]
    _, edit = chosen(steps, make_requirement(6), effects=KNOWN, rules=only)
    assert edit.after < 400
    refused = choose(steps, TABLES, make_requirement(6, overshoot=0), only, KNOWN, ())
    assert refused == ["too fast: H9 slower turns (would harm the overshoot more)"]


def test_a_step_flown_nearby_says_what_an_edit_would_break():
    # between the two steps, nearer to the faster one; where that one lost trials, longer training promises more
    wanted = make_requirement(2, tolerance=2)
    rules = [rule for rule in RULES if rule.field in (SPEED, "apg.updates")]
    steps = after([step(settling_time=2.2)], wanted, settling_time=1.985)
    origin, edit = choose(steps, TABLES, make_requirement(2.05, tolerance=2), rules, UNKNOWN, ())
    assert (edit.field, edit.known_from) == (SPEED, "between")
    steps[1] = dataclasses.replace(steps[1], measured=dataclasses.replace(steps[1].measured, settled=0.985))
    origin, edit = choose(steps, TABLES, wanted, rules, UNKNOWN, ())
    assert (origin.number, edit.field) == (1, "apg.updates")


def test_an_edit_that_the_task_cannot_have_beside_its_other_fields_is_left_out():
    # narrow may not be wider than wide
    tables = document.edit(TABLES, "reward.horizontal.wide", 15.0)
    lower = dataclasses.replace(
        RULES[0], field="reward.horizontal.narrow", direction="down", slope=0.8, range=(1.0, 100.0)
    )
    found = choose([step(settling_time=4.0)], tables, make_requirement(2), [lower], UNKNOWN, ())
    assert found == ["H7 faster (reward.horizontal.narrow 8.41 is not allowed in this task)"]
    _, edit = choose([step(settling_time=4.0)], tables, make_requirement(2), [lower, RULES[0]], UNKNOWN, ())
    assert (edit.field, edit.second) == (SPEED, None)


def test_the_next_best_edit_is_of_another_field():
    _, edit = chosen([step(settling_time=4.0)], make_requirement(2))
    assert edit.second is not None
    assert edit.second.field != edit.field
    assert edit.second.second is None


def test_an_edit_knows_its_unit():
    _, edit = chosen([step(settling_time=4.0)], make_requirement(2))
    assert edit.unit == "m/s"


def test_a_step_is_read_back_as_it_was_written():
    steps = after([step(settling_time=4.0)], make_requirement(2), settling_time=math.inf)
    told = json.loads(json.dumps([each.to_dict() for each in steps]))
    assert [Step.from_dict(each) for each in told] == steps
