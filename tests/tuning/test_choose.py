"""The choice of the next edit, on made-up responses: by the rules, earlier iterations and sensitivities."""

import dataclasses
import json
import math

import pytest

from flytune.config import document, nested
from flytune.task.files import load_task
from flytune.tuning.asked import make_requirement
from flytune.tuning.choose import choose
from flytune.tuning.iteration import HALF_WAY, Iteration
from flytune.tuning.requirement import ResponseSummary
from flytune.tuning.rules import load_rules
from flytune.tuning.sensitivity import load_sensitivities
from flytune.tuning.slopes import Context

TABLES = document.plain(load_task("baseline-refined"))
SPEED = "termination.speed.bound"
GOOD = ResponseSummary(settling_time=2.0, overshoot=0.0, error=0.001, settled=1.0, constraints_satisfied=1.0)
KNOWN = load_sensitivities()
UNKNOWN = dataclasses.replace(KNOWN, parameters={})
RULES = load_rules()


def iteration(number=0, values=None, edit=None, parent=None, **response):
    return Iteration(
        number=number,
        values=values or {},
        reasons=dict.fromkeys(values or {}, "so"),
        edit=edit,
        parent=parent,
        response=dataclasses.replace(GOOD, **response),
        trials=100,
        seconds=1.0,
    )


def choice(*known, trainer="apg"):
    return choose(Context(*known, trainer))


def chosen(iterations, wanted, fixed=(), sensitivities=UNKNOWN, rules=RULES):
    found = choice(iterations, TABLES, wanted, rules, sensitivities, fixed)
    assert not isinstance(found, list), found
    return found


def after(iterations, wanted, **response):
    """The iterations, and one more with the next edit and the given response."""
    parent, edit = chosen(iterations, wanted)
    values = {**parent.values, edit.field: edit.after}
    return [*iterations, iteration(len(iterations), values, edit, parent.number, **response)]


@pytest.mark.parametrize(("time", "name", "way"), [(4.0, "H7 faster", 1), (1.0, "H7 slower", -1)])
def test_a_response_that_is_off_in_time_moves_the_speed_bound(time, name, way):
    _, edit = chosen([iteration(settling_time=time)], make_requirement(2))
    assert (edit.rule, edit.field, edit.before) == (name, SPEED, 0.8)
    assert (edit.after - edit.before) * way > 0
    # slope -0.8: to halve the time the bound is multiplied by 2^(1/0.8)
    assert edit.after == pytest.approx(0.8 * 2 ** (way / 0.8), rel=0.01)
    assert edit.expected == pytest.approx(2.0, rel=0.01)


def test_the_second_edit_uses_the_slope_of_the_first():
    wanted = make_requirement(2)
    iterations = after([iteration(settling_time=4.0)], wanted, settling_time=2.5)
    first = iterations[1].edit
    slope = math.log(2.5 / 4) / math.log(first.after / first.before)
    _, edit = chosen(iterations, wanted)
    assert edit.known_from == "iterations"
    assert math.log(edit.after / first.after) == pytest.approx(math.log(2 / 2.5) / slope, rel=0.02)


def test_between_a_faster_and_a_slower_iteration_the_bound_is_interpolated():
    wanted = make_requirement(2)
    iterations = after([iteration(settling_time=4.0)], wanted, settling_time=1.5)
    _, edit = chosen(iterations, wanted)
    share = math.log(2 / 1.5) / math.log(4 / 1.5)
    assert edit.after == pytest.approx(iterations[1].edit.after * (0.8 / iterations[1].edit.after) ** share, rel=0.01)


def test_a_curved_relation_is_not_followed_in_ever_smaller_edits():
    # the time hardly depends on the bound but at its lower end, where it grows to ten times
    def time_at(bound):
        return 1.9 + 18 * math.exp(-40 * (bound - 0.3))

    wanted = make_requirement(3, tolerance=5)
    only = [rule for rule in RULES if rule.field == SPEED]
    iterations = [
        iteration(settling_time=time_at(0.8)),
        iteration(1, {SPEED: 0.3}, None, 0, settling_time=time_at(0.3)),
    ]
    while wanted.misses(iterations[-1].response):
        parent, edit = chosen(iterations, wanted, rules=only)
        values = {SPEED: edit.after}
        iterations = [
            *iterations,
            iteration(len(iterations), values, edit, parent.number, settling_time=time_at(edit.after)),
        ]
    assert len(iterations) <= 8  # without it, 12


def test_a_parameter_with_a_threshold_is_edited_again_beyond_it():
    # the velocity weight makes the response slower beyond 0.2; a small effect from 0.1 to 0.2 does not rule it out
    wanted = make_requirement(5)
    only = [rule for rule in RULES if rule.field == "reward.velocity.weight"]
    _, edit = chosen([iteration(settling_time=3.0)], wanted, sensitivities=KNOWN, rules=only)
    iterations = [iteration(settling_time=3.0), iteration(1, {edit.field: edit.after}, edit, 0, settling_time=3.05)]
    parent, again = chosen(iterations, wanted, sensitivities=KNOWN, rules=only)
    assert (parent.number, again.before, again.known_from) == (1, edit.after, "sensitivity")


def test_what_the_user_has_fixed_is_not_touched():
    wanted = make_requirement(2)
    _, edit = chosen([iteration(settling_time=4.0)], wanted, fixed=(SPEED,))
    assert edit.field != SPEED
    _, edit = chosen([iteration(settling_time=4.0)], wanted, fixed=("termination",))
    assert not edit.field.startswith("termination.")


def test_where_every_field_is_fixed_each_rule_names_it():
    found = choice(
        [iteration(settling_time=4.0)], TABLES, make_requirement(2), RULES, UNKNOWN, ("termination", "reward")
    )
    assert isinstance(found, list)
    assert found
    assert found[0].startswith("too slow: H7 faster (termination.speed.bound is set by the user), ")
    assert found[0].count("is set by the user") == len([rule for rule in RULES if rule.when == "too slow"])


def test_a_rule_that_did_not_help_is_not_used_again():
    wanted = make_requirement(2)
    iterations = after([iteration(settling_time=4.0)], wanted, settling_time=4.0)
    _, edit = chosen(iterations, wanted)
    assert edit.rule != iterations[1].edit.rule


def test_a_rule_stops_at_the_end_of_its_range():
    rules = [dataclasses.replace(rule, range=(0.05, 0.8)) if rule.field == SPEED else rule for rule in RULES]
    _, edit = chosen([iteration(settling_time=4.0)], make_requirement(2), rules=rules)
    assert edit.field != SPEED


def test_half_of_an_edit_that_makes_trials_unsettled_is_taken_back():
    wanted = make_requirement(2)
    iterations = after([iteration(settling_time=4.0)], wanted, settling_time=math.inf, settled=0.3)
    parent, edit = chosen(iterations, wanted)
    assert (parent.number, edit.rule, edit.field) == (0, HALF_WAY, SPEED)
    assert edit.after == pytest.approx(math.sqrt(0.8 * iterations[1].edit.after), rel=0.01)


@pytest.mark.parametrize(
    ("response", "symptom"),
    [({"overshoot": 0.2}, "overshoots"), ({"error": 0.015}, "inaccurate"), ({"settled": 0.9}, "unsettled")],
)
def test_each_symptom_has_its_rules(response, symptom):
    _, edit = chosen([iteration(**response)], make_requirement(2))
    assert edit.symptom == symptom


def test_a_rule_is_not_used_while_a_measure_it_requires_is_missed():
    # with too much overshoot, H6 must not lower the velocity weight to be faster
    iterations = [iteration(settling_time=4.0, overshoot=0.2)]
    only = [rule for rule in RULES if rule.name == "H6 faster"]
    found = choice(iterations, TABLES, make_requirement(2), only, UNKNOWN, ())
    assert found == ["too slow: H6 faster (not while the overshoot is missed)"]


def test_a_rule_that_was_measured_to_do_the_opposite_is_not_used():
    curve = KNOWN.parameters[SPEED]
    upside_down = dataclasses.replace(KNOWN, parameters={"reward.velocity.weight": curve})  # up is faster there
    rules = [rule for rule in RULES if rule.name == "H6 faster"]
    found = choice([iteration(settling_time=4.0)], TABLES, make_requirement(2), rules, upside_down, ())
    assert found == ["too slow: H6 faster (its measured effect there is opposite)"]


def test_the_measured_sensitivity_gives_the_size_of_an_edit():
    _, edit = chosen([iteration(settling_time=4.0)], make_requirement(2), sensitivities=KNOWN)
    assert (edit.field, edit.known_from) == (SPEED, "sensitivity")
    slope = KNOWN.slope(SPEED, "settling_time", 0.8)
    assert edit.after == pytest.approx(min(2.4, 0.8 * math.exp(math.log(0.5) / slope)), rel=0.01)


def test_no_edit_is_made_twice():
    # two iterations bracket the target, and in every one near the target some trials do not settle
    wanted = make_requirement(2, tolerance=2)
    only = [rule for rule in RULES if rule.field == SPEED]
    iterations = after([iteration(settling_time=2.5)], wanted, settling_time=1.7)
    for _ in range(20):
        found = choice(iterations, TABLES, wanted, only, UNKNOWN, ())
        if isinstance(found, list):
            break
        parent, edit = found
        tried = [each.values.get(SPEED, 0.8) for each in iterations]
        assert all(abs(math.log(edit.after / value)) >= 0.01 for value in tried)
        iterations = [
            *iterations,
            iteration(len(iterations), {SPEED: edit.after}, edit, parent.number, settling_time=2.0, settled=0.95),
        ]
    assert 3 <= len(iterations) < 20


def test_the_iteration_is_edited_whose_edit_is_predicted_to_come_nearest():
    # iteration 1 is much too fast; iteration 0 is far nearer
    wanted = make_requirement(2)
    iterations = after([iteration(settling_time=2.3)], wanted, settling_time=0.4)
    parent, edit = chosen(iterations, wanted)
    assert parent.number == 0
    assert edit.known_from == "interpolation"


def test_a_setting_of_another_trainer_is_left_alone():
    lame = [iteration(settled=0.9)]
    longer = [rule for rule in RULES if rule.field in ("apg.updates", "ppo.steps")]
    for trainer, field in (("apg", "apg.updates"), ("ppo", "ppo.steps")):
        found = choice(lame, TABLES, make_requirement(2), longer, KNOWN, (), trainer=trainer)
        assert not isinstance(found, list)
        assert found[1].field == field


def test_a_parameter_without_a_measured_effect_is_edited_with_another_trainer_only():
    only = [rule for rule in RULES if rule.name == "H1 bolder"]
    found = choice([iteration(settling_time=4.0)], TABLES, make_requirement(2), only, KNOWN, ())
    assert found == ["too slow: H1 bolder (it has no measured effect)"]
    bolder = [dataclasses.replace(rule, slope=-0.5) for rule in only]
    found = choice([iteration(settling_time=4.0)], TABLES, make_requirement(2), bolder, KNOWN, (), trainer="ppo")
    assert not isinstance(found, list)
    assert found[1].known_from == "rule"


def test_each_axis_has_a_parameter_of_its_own():
    fixed = (SPEED,)
    _, edit = chosen([iteration(settling_time=1.4)], make_requirement(1.0, axis="z"), fixed, KNOWN)
    assert edit.field == "reward.vertical.sharpness"
    _, edit = chosen([iteration(settling_time=0.3)], make_requirement(0.6, axis="yaw"), (), KNOWN)
    assert edit.field == "termination.body_rate.bound_deg_per_s"


def test_an_edit_that_makes_another_measure_miss_is_refused():
    # a rate bound of 230 deg/s instead of 530 makes the position slower, and overshoot by 1.7 %
    only = [rule for rule in RULES if rule.name == "H9 slower turns"]
    iterations = [iteration(settling_time=2.86)]
    _, edit = chosen(iterations, make_requirement(6), sensitivities=KNOWN, rules=only)
    assert edit.after < 400
    refused = choice(iterations, TABLES, make_requirement(6, overshoot=0), only, KNOWN, ())
    assert refused == ["too fast: H9 slower turns (it would make the overshoot worse)"]


def test_the_nearest_iteration_predicts_the_other_measures_of_an_edit():
    # the edit is nearer to the faster iteration; where trials do not settle, a longer training is predicted better
    wanted = make_requirement(2, tolerance=2)
    rules = [rule for rule in RULES if rule.field in (SPEED, "apg.updates")]
    iterations = after([iteration(settling_time=2.2)], wanted, settling_time=1.985)
    parent, edit = choice(iterations, TABLES, make_requirement(2.05, tolerance=2), rules, UNKNOWN, ())
    assert (edit.field, edit.known_from) == (SPEED, "interpolation")
    iterations[1] = dataclasses.replace(
        iterations[1], response=dataclasses.replace(iterations[1].response, settled=0.985)
    )
    parent, edit = choice(iterations, TABLES, wanted, rules, UNKNOWN, ())
    assert (parent.number, edit.field) == (1, "apg.updates")


def test_an_edit_that_the_task_cannot_have_beside_its_other_fields_is_left_out():
    # narrow may not be wider than wide
    tables = nested.edit(TABLES, "reward.horizontal.wide", 15.0)
    lower = dataclasses.replace(
        RULES[0], field="reward.horizontal.narrow", direction="down", slope=0.8, range=(1.0, 100.0)
    )
    found = choice([iteration(settling_time=4.0)], tables, make_requirement(2), [lower], UNKNOWN, ())
    assert found == ["H7 faster (reward.horizontal.narrow 8.41 is not allowed in this task)"]
    _, edit = choice([iteration(settling_time=4.0)], tables, make_requirement(2), [lower, RULES[0]], UNKNOWN, ())
    assert (edit.field, edit.next_best) == (SPEED, None)


def test_the_next_best_edit_is_of_another_field():
    _, edit = chosen([iteration(settling_time=4.0)], make_requirement(2))
    assert edit.next_best is not None
    assert edit.next_best.field != edit.field
    assert edit.next_best.next_best is None


def test_an_edit_knows_its_unit():
    _, edit = chosen([iteration(settling_time=4.0)], make_requirement(2))
    assert edit.unit == "m/s"


def test_an_iteration_is_read_back_as_it_was_written():
    iterations = after([iteration(settling_time=4.0)], make_requirement(2), settling_time=math.inf)
    told = json.loads(json.dumps([each.to_dict() for each in iterations]))
    assert [Iteration.from_dict(each) for each in told] == iterations
