"""The rules: every one can be used, impossible ones are refused, and those of a user join them."""

import dataclasses
import re

import pytest

from flytune.config import document
from flytune.errors import BadInput
from flytune.task.files import load_task
from flytune.tuning.rules import apply_rule, is_fixed, load_rules, number_at, rules_table, symptoms

RULES = load_rules()


def test_every_heuristic_of_the_paper_is_among_the_rules():
    found = set(re.findall(r"H\d+", " ".join(rule.source for rule in RULES)))
    assert found == {f"H{number}" for number in range(1, 12)}


@pytest.mark.parametrize("rule", [rule for rule in RULES if not rule.advice], ids=lambda rule: rule.name)
def test_a_rule_edits_a_number_of_a_known_task_that_may_be_moved_to_both_ends(rule):
    names = ("baseline-refined", "acrobatic-refined", "inspection-refined")
    having = [name for name in names if number_at(document.plain(load_task(name)), rule.field) is not None]
    assert having
    for name in having:
        for end in rule.range:
            load_task(name, {rule.field: int(end) if rule.field in ("apg.updates", "ppo.steps") else float(end)})


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ('name = "a"', "when: missing"),
        (
            'name = "a"\nwhen = "too slow"\nfield = "x.y"\ndirection = "up"\nslope = 0.5\nrange = [1, 2]',
            "below 0, or it",
        ),
        ('name = "a"\nwhen = "too lame"\nfield = "x"\ndirection = "up"\nslope = 1.0', "when"),
        ('name = "a"\nwhen = "too slow"\nfield = "x"\ndirection = "up"\nslope = -1.0\nrange = [3, 2]', "smaller first"),
        ('name = "a"\nwhen = "too slow"\nfield = "x"\ndirection = "up"\nslope = -1.0\nlargest = 1.0', "largest"),
        ('name = "a"\nadvise = "b"', "advise: no such field"),
        ('name = "a"\nadvice = """b\nc"""', "holds a line break"),
    ],
)
def test_a_rule_that_cannot_be_used_is_refused_with_its_number(tmp_path, rule, said):
    path = tmp_path / "mine.toml"
    path.write_text(f"[[rule]]\n{rule}\n")
    with pytest.raises(BadInput, match=rf"mine\.toml: rule 1.*{said}"):
        load_rules(path)


def test_a_file_without_rules_is_refused(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("a = 1\n")
    with pytest.raises(BadInput, match="holds no rule"):
        load_rules(path)


def test_rules_of_the_user_replace_those_of_the_same_name_and_join_the_others(tmp_path):
    path = tmp_path / "mine.toml"
    body = 'when = "too slow"\nfield = "reward.attitude.weight"\ndirection = "down"\nslope = 0.1\nrange = [0.1, 1.0]\n'
    path.write_text(f'[[rule]]\nname = "H7 faster"\n{body}\n[[rule]]\nname = "mine"\n{body}')
    rules = {rule.name: rule for rule in load_rules(path)}
    assert len(rules) == len(RULES) + 1
    assert rules["H7 faster"].field == rules["mine"].field == "reward.attitude.weight"
    assert "mine" in rules_table(list(rules.values()))


def test_an_edit_stays_within_its_largest_factor_and_its_range():
    rule = dataclasses.replace(RULES[0], largest=2.0, range=(0.1, 3.0))
    assert apply_rule(rule, 1.0, 1.5) == 1.5
    assert apply_rule(rule, 1.0, 5.0) == 2.0
    assert apply_rule(rule, 2.0, 2.0) == 3.0
    assert apply_rule(rule, 0.15, 0.1) == 0.1


def test_trials_that_do_not_settle_come_first():
    assert symptoms({"error": 1.0, "settling_time": -0.3, "settled": -0.2}) == ["unsettled", "too fast", "inaccurate"]


def test_a_field_is_fixed_where_it_or_a_table_above_it_was_set():
    assert is_fixed("apg.updates", ("apg.updates",))
    assert is_fixed("termination.speed.bound", ("reward", "termination.speed"))
    assert not is_fixed("termination.speed.bound", ("termination.spee", "reward.velocity.weight"))


def test_the_table_shows_symptom_edit_size_and_reason_of_every_rule():
    lines = rules_table(RULES).splitlines()
    line = next(line for line in lines if line.startswith("H6 faster"))
    for words in ("too slow", "reward.velocity.weight down", "x 2", "0.01 to 1", "settling time ~ field^0.15",
                  "overshoot missed", "penalises speed less (paper H6)"):  # fmt: skip
        assert words in line
    assert next(line for line in lines if line.startswith("H10 split: ")).endswith("(paper H10)")
