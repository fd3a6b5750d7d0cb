"""Tasks: the presets hold the paper's numbers, are written and read back exactly, and bad ones are refused."""

import dataclasses
import math
import re

import jax
import pytest

from flytune.config import document
from flytune.config.document import source_of
from flytune.config.nested import leaves
from flytune.errors import BadInput
from flytune.physics.vehicle import load_vehicle, vehicle_names
from flytune.task.files import RENAMED, load_task, preset_names, read_task_text, write_task
from flytune.task.reward import DualExponential, Exponential, Smoothness, Survival

PAPER_REWARDS = {
    "baseline": {  # R11
        "survival": Survival(reward=0.05),
        "horizontal": DualExponential(of="horizontal", weight=0.25, share=0.6, wide=0.5, narrow=20.0),
        "vertical": Exponential(of="vertical", weight=0.25, sharpness=4.0),
        "velocity": Exponential(of="velocity", weight=0.1, sharpness=1.0),
        "attitude": Exponential(of="attitude", weight=0.15, sharpness=0.5),
        "smoothness": Smoothness(weight=0.1),
    },
    "acrobatic": {  # R12
        "survival": Survival(reward=0.05),
        "horizontal": DualExponential(of="horizontal", weight=0.25, share=0.6, wide=4.0, narrow=20.0),
        "vertical": Exponential(of="vertical", weight=0.25, sharpness=4.0),
        "velocity": Exponential(of="velocity", weight=0.08, sharpness=0.5),
        "attitude": Exponential(of="attitude", weight=0.15, sharpness=0.5),
        "smoothness": Smoothness(weight=0.1),
    },
    "inspection": {  # R13
        "survival": Survival(reward=0.01),
        "horizontal": DualExponential(of="horizontal", weight=0.25, share=0.6, wide=4.0, narrow=150.0),
        "vertical": DualExponential(of="vertical", weight=0.25, share=0.6, wide=4.0, narrow=150.0),
        "velocity": Exponential(of="velocity", weight=0.15, sharpness=1.5),
        "attitude": DualExponential(of="attitude", weight=0.2, share=0.6, wide=0.5, narrow=150.0),
        "smoothness": Smoothness(weight=0.02),
    },
}


def refusal(task="baseline", **edits):
    """The one line a task is refused with."""
    with pytest.raises(BadInput) as caught:
        load_task(task, {path.replace("__", "."): value for path, value in edits.items()})
    text = str(caught.value)
    assert "\n" not in text
    return text


# --- what ships ---


def test_the_three_presets_of_the_paper_ship_each_with_a_refined_one():
    assert preset_names() == sorted([*PAPER_REWARDS, *(f"{name}-refined" for name in PAPER_REWARDS), "dial"])


@pytest.mark.parametrize("preset", PAPER_REWARDS)
def test_a_preset_pays_exactly_what_the_paper_pays(tasks, preset):
    assert tasks[preset].reward == PAPER_REWARDS[preset]


@pytest.mark.parametrize("preset", PAPER_REWARDS)
def test_a_preset_flies_the_papers_vehicle_to_the_papers_target(tasks, preset):
    task = tasks[preset]
    assert task.name == preset
    assert task.vehicle == load_vehicle("crazyflie")
    assert (task.target.position, task.target.yaw) == ((0, 0, 1), 0)  # R19
    start = task.initial_state  # R15
    assert (start.lowest_position, start.highest_position) == ((-1, -1, 0.1), (1, 1, 2))
    assert (start.largest_tilt, start.largest_yaw) == (0.2, math.pi)
    assert task.horizon == 500  # 5 s


def test_a_trial_lasts_ten_seconds_and_twenty_for_the_slow_inspection(tasks):
    assert {name: tasks[name].duration for name in PAPER_REWARDS} == {
        "acrobatic": 10,
        "baseline": 10,
        "inspection": 20,
    }


@pytest.mark.parametrize("preset", PAPER_REWARDS)
def test_a_preset_is_learned_with_the_papers_settings(tasks, preset):
    ppo = tasks[preset].ppo
    assert (ppo.minibatch, ppo.learning_rate, ppo.epochs, ppo.clip_range) == (128, 2e-4, 12, 0.15)  # R17
    assert (ppo.steps, ppo.hidden) == (6_000_000, (64, 64))  # R18, R16
    assert ppo.environments * ppo.rollout == 4 * 4096  # the samples of R18
    # Stable-Baselines3's defaults
    assert (ppo.discount, ppo.gae_lambda, ppo.value_weight, ppo.max_grad_norm) == (0.99, 0.95, 0.5, 0.5)
    assert (ppo.entropy_weight, ppo.initial_log_std) == (0.0, 0.0)


def test_the_speed_bound_is_the_tightest_speed_termination(tasks):
    assert {name: tasks[name].speed_bound for name in PAPER_REWARDS} == {
        "acrobatic": 1.0,
        "baseline": 0.8,
        "inspection": 0.2,
    }
    free = dataclasses.replace(tasks["baseline"], termination={})
    assert free.speed_bound is None


# --- written and read back ---


# each preset, and each vehicle
PAIRS = [*((preset, "crazyflie") for preset in preset_names()), *(("baseline", each) for each in vehicle_names()[1:])]


@pytest.fixture(scope="module")
def every():
    """Every preset with every vehicle, and the text of each."""
    tasks = {(preset, vehicle): load_task(preset, {"vehicle": vehicle}) for preset, vehicle in PAIRS}
    return {name: (task, write_task(task)) for name, task in tasks.items()}


@pytest.mark.parametrize(("preset", "vehicle"), PAIRS)
def test_a_task_is_read_back_exactly_as_it_was_written(every, preset, vehicle):
    task, text = every[preset, vehicle]
    assert task.vehicle == load_vehicle(vehicle)
    again = read_task_text(text, "task.toml")
    assert again == task
    assert jax.tree.structure(again) == jax.tree.structure(task)
    assert write_task(again) == text


@pytest.mark.parametrize("preset", preset_names())
def test_a_written_task_is_a_task_file(every, preset, tmp_path):
    task, text = every[preset, "crazyflie"]
    (tmp_path / "mine.toml").write_text(text)
    assert load_task(tmp_path / "mine.toml") == task
    assert load_task(str(tmp_path / "mine.toml"), {"reward.velocity.weight": 0.3}).reward["velocity"].weight == 0.3


def test_a_task_without_terminations_is_read_back():
    task = load_task("baseline", {"termination": {}})
    assert task.termination == {} and task.speed_bound is None
    assert read_task_text(write_task(task), "task.toml") == task


def test_every_number_is_written_with_its_unit_its_range_and_where_it_comes_from(every):
    lines = every["baseline", "crazyflie"][1].splitlines()
    for line in (
        "bound = 0.8 # m/s; above 0; paper R14",
        "narrow = 20.0 # 1/unit(e)^2; 0 or more; paper R11",
        "body_rate = 0.002 # rad/s; 0 to 100; paper R8",
        "mass = 0.033 # kg; above 0; paper R5",
        "position = [0.0, 0.0, 1.0] # m; 3 values, each -1000 to 1000; paper R19",
        "learning_rate = 0.0002 # 1; above 0; paper R17",
    ):
        assert line in lines


@pytest.mark.parametrize("preset", preset_names())
def test_no_number_of_a_preset_is_written_without_a_source(every, preset):
    text = every[preset, "crazyflie"][1]
    text = text.replace("= true # ", "= true # 1; ").replace("= false # ", "= false # 1; ")  # a yes or no has no unit
    numbers = [line for line in text.split("[sources]")[0].splitlines() if " = " in line and '= "' not in line]
    assert len(numbers) > 50
    assert [line for line in numbers if line.count("; ") < 2] == []


# --- edits ---


def test_an_edit_changes_one_number_and_says_who_did_it(tasks):
    task = load_task("baseline", {"reward.velocity.weight": 0.3, "termination.speed.bound": 1.5})
    assert task.reward["velocity"] == Exponential(of="velocity", weight=0.3, sharpness=1.0)
    assert task.speed_bound == 1.5
    assert task.sources["reward.velocity.weight"] == "set by the user"
    assert "weight = 0.3 # 1; 0 or more; set by the user" in write_task(task)
    undone = load_task("baseline", {"reward.velocity.weight": 0.1})
    assert undone.reward == tasks["baseline"].reward


def test_a_vehicle_is_chosen_by_name_and_edited_by_path():
    task = load_task("baseline", {"vehicle": "crazyflie-measured", "vehicle.mass": 0.04})
    assert task.vehicle.mass == 0.04
    assert task.vehicle.motor_rise_time_constant == 0.136
    assert "mass = 0.04 # kg; above 0; set by the user" in write_task(task)


def test_a_term_may_be_added_and_needs_to_be_complete():
    task = load_task(
        "baseline", {"reward.spin": {"kind": "exponential", "of": "body_rate", "weight": 0.1, "sharpness": 1.0}}
    )
    assert task.reward["spin"] == Exponential(of="body_rate", weight=0.1, sharpness=1.0)
    assert refusal(reward__spin={"kind": "exponential", "of": "body_rate", "weight": 0.1}) == (
        "reward.spin.sharpness: missing. Allowed: 0 or more 1/unit(e)^2."
    )


# --- what is refused ---


def test_an_unknown_preset_is_refused_with_the_nearest_name():
    text = refusal("baselin")
    allowed = (
        "acrobatic, acrobatic-refined, baseline, baseline-refined, dial, inspection, inspection-refined, a .toml file, "
        "or a run directory."
    )
    assert text.startswith(f"task: 'baselin' is no preset. Allowed: {allowed}")
    assert text.endswith("Did you mean baseline?")
    assert "Did you mean" not in refusal("zzz")


def test_an_unknown_key_is_refused_with_the_nearest_one():
    # the error of the specification, word for word
    assert refusal(reward__velocity__wieght=0.2) == (
        "reward.velocity.wieght: no such field. Did you mean reward.velocity.weight (now 0.1, allowed: 0 or more)?"
    )
    assert refusal(horizn=3).startswith("horizn: no such field. Did you mean horizon (now 500, allowed: a whole number")


@pytest.mark.parametrize(
    ("edits", "start"),
    [
        ({"reward__velocity__weight": "much"}, "reward.velocity.weight: 'much' is not allowed. Allowed: 0 or more."),
        ({"reward__velocity__weight": math.nan}, "reward.velocity.weight: nan is not allowed. Allowed: 0 or more."),
        ({"reward__velocity__weight": math.inf}, "reward.velocity.weight: inf is not allowed. Allowed: 0 or more."),
        ({"reward__velocity__weight": -0.1}, "reward.velocity.weight: -0.1 is not allowed. Allowed: 0 or more."),
        ({"reward__velocity__of": "speed"}, "reward.velocity.of: 'speed' is not allowed. Allowed: one of horizontal,"),
        ({"reward__velocity__kind": "exponental"}, "reward.velocity.kind: 'exponental' is none of: survival, expo"),
        ({"reward__horizontal__narrow": 0.1}, "reward.horizontal.narrow: 0.1 is wider than `wide`. Allowed: 0.5"),
        ({"reward": {}}, "reward: no term. Allowed: one or more tables [reward.NAME]."),
        ({"termination__speed__bound": 0.0}, "termination.speed.bound: 0.0 is not allowed. Allowed: above 0 m/s."),
        ({"termination__attitude__bound": 4.0}, "termination.attitude.bound: 4.0 is not allowed. Allowed: above 0 to"),
        ({"horizon": 1.5}, "horizon: 1.5 is not allowed. Allowed: a whole number, 1 to 1000000"),
        ({"horizon": 0}, "horizon: 0 is not allowed."),
        ({"duration": 0.5}, "duration: 0.5 is not allowed. Allowed: above 0.5 to 3600 s."),
        ({"duration": 5000.0}, "duration: 5000.0 is not allowed. Allowed: above 0.5 to 3600 s."),
        ({"name": "../elsewhere"}, "name: '../elsewhere' cannot name a run."),
        ({"sources": 3, "horizon": 400}, "sources: 3 is not allowed. Allowed: a table."),
        ({"target__position": [0.0, 1.0]}, "target.position"),
        (
            {"target__position": "home"},
            "target.position: 'home' is not allowed. Allowed: 3 values, each -1000 to 1000 m",
        ),
        ({"initial_state__lowest_position": [0.0, 0.0, 3.0]}, "initial_state.lowest_position: 3.0 in z lies above"),
        ({"vehicle__mass": 0.0}, "vehicle.mass: 0.0 is not allowed. Allowed: above 0 kg."),
        ({"vehicle__maximum_rotor_speed_rpm": 100.0}, "vehicle.maximum_rotor_speed_rpm: 100.0 cannot lift"),
        ({"vehicle": "crazyfly"}, "vehicle: 'crazyfly' is no vehicle."),
        ({"vehicle": 3}, "vehicle: 3 is not allowed for a table. Give one of crazyflie, "),
        (
            {"termination__speed": 3},
            "termination.speed: 3 is not allowed for a table. Edit what is in it: termination.",
        ),
        ({"ppo__minibatch": 100}, "ppo.minibatch: 100 does not divide environments * rollout = 16384."),
        ({"target__yaw": 180.0}, "target.yaw: 180.0 is not allowed. Allowed: -6.28"),
        (
            {"target__position": [0.0, 0.0, 5000.0]},
            "target.position.2: 5000.0 is not allowed. Allowed: -1000 to 1000 m",
        ),
        ({"initial_state__largest_tilt": 15.0}, "initial_state.largest_tilt: 15.0 is not allowed."),
        ({"termination__body_rate__bound_deg_per_s": 9.25}, "termination.body_rate.bound_deg_per_s: 9.25 is not al"),
        ({"vehicle__arm": 28.0}, "vehicle.arm: 28.0 is not plausible: arm is 28 m. Allowed: 0.008 to 3 m (usual: 0.02"),
        ({"ppo__environments": 1, "ppo__rollout": 1}, "ppo.rollout: 1 steps of 1 environments are 1 samples per upd"),
        ({"apg__environments": 10**6, "apg__window": 10**6}, "apg.window: 1000000 steps of 1000000 environments are"),
        ({"reward__velocity__weight": 1e39}, "reward.velocity.weight: 1e+39 is not allowed: numbers are single"),
        ({"horizon__steps": 3}, "horizon.steps: horizon is a value, not a table."),
    ],
)
def test_a_bad_value_is_refused_with_one_line_that_names_it(edits, start):
    assert refusal(**edits).startswith(start)


@pytest.mark.parametrize(
    ("content", "start"),
    [
        (b"horizon = ", ": is not valid TOML: "),
        (b"\xff\xfe\x00", ": is not text."),
        (b"", ": horizon: missing."),
        (b'vehicle = "crazyfly"', ": vehicle: 'crazyfly' is no vehicle."),
    ],
)
def test_a_file_that_is_no_task_is_refused_by_its_name(tmp_path, content, start):
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    text = refusal(path)
    assert text.startswith(f"{path}{start}")


def test_a_missing_file_is_refused(tmp_path):
    path = tmp_path / "none.toml"
    assert refusal(path).startswith(f"{path}: cannot be read (No such file or directory).")
    assert refusal(tmp_path).startswith("task: ")


def test_a_text_that_is_no_complete_task_is_refused():
    with pytest.raises(BadInput, match=r"^old/task\.toml: .*: missing\."):
        read_task_text("horizon = 3", "old/task.toml")


def test_a_file_based_on_a_preset_says_only_what_it_changes(tmp_path):
    file = tmp_path / "mine.toml"
    changes = ["[reward.velocity]", "weight = 0.2", "[sources]", '"reward.velocity.weight" = "mine"']
    file.write_text("\n".join(['based_on = "baseline"', *changes]))
    task, base = load_task(file), load_task("baseline")
    assert task.name == "mine"
    assert task.reward["velocity"].weight == 0.2
    assert task.reward["velocity"].sharpness == base.reward["velocity"].sharpness
    assert document.plain(task)["termination"] == document.plain(base)["termination"]
    assert task.sources["reward.velocity.weight"] == "mine" and task.sources["reward"] == "paper R11"


def test_what_a_file_changes_has_the_file_as_its_source_and_not_the_paper(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(
        'based_on = "baseline"\n[reward.survival]\nreward = 0.1\n'
        '[reward.level]\nkind = "exponential"\nof = "attitude"\n'
        "weight = 0.2\nsharpness = 1.0\n"
        '[sources]\n"reward.level" = "measured in the laboratory"\n'
    )
    lines = write_task(load_task(file)).splitlines()
    sources = {name: [line.rsplit("; ", 1)[-1] for line in lines if line.startswith(f"{name} =")] for name in
               ("reward", "weight", "wide")}  # fmt: skip
    assert sources["reward"][0] == "set in mine.toml"
    assert "measured in the laboratory" in sources["weight"] and "set in mine.toml" not in sources["wide"]


def test_a_file_based_on_nothing_that_ships_is_refused(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('based_on = "besaline"\n')
    with pytest.raises(BadInput, match=r"based_on: 'besaline' is no preset\. Allowed: acrobatic"):
        load_task(file)


@pytest.mark.parametrize("role", ["baseline", "acrobatic", "inspection"])
def test_a_refined_preset_gives_a_reason_for_everything_it_changes(role):
    refined, printed = (load_task(name) for name in (f"{role}-refined", role))
    before = dict(leaves(document.plain(printed)))
    changed = {
        path
        for path, value in leaves(document.plain(refined))
        if not path.startswith(("name", "sources")) and before.get(path) != value
    }
    assert changed
    assert {path for path in changed if not source_of(path, refined.sources).startswith("refined: ")} == set()


@pytest.mark.parametrize("old", RENAMED)
def test_a_key_that_was_renamed_is_refused_with_its_new_name_in_files_and_in_edits(old, tmp_path):
    new = RENAMED[old]
    message = re.escape(f"{old}: is called {new} now. Write {new} instead.")
    with pytest.raises(BadInput, match=f"^{message}$"):
        load_task("baseline", {old: 0.5})
    table, key = old.split(".")
    (tmp_path / "old.toml").write_text(f'based_on = "baseline"\n[{table}]\n{key} = 0.5\n')
    with pytest.raises(BadInput, match=f"^.*old.toml: {message}$"):
        load_task(tmp_path / "old.toml")
    kept = load_task("baseline", {new: False if "clipping" in new else 0.5})
    assert getattr(getattr(kept, table), new.split(".")[1]) in (0.5, False)
