"""Task files: what they are based on, paths in them, what they remove, and where a wrong path was meant to lead."""

import os
import shutil

import pytest
from tests.airframes import airframe

from flytune.config import document
from flytune.errors import BadInput
from flytune.task.files import load_task, read_task_text, write_task


@pytest.fixture
def folder(tmp_path):
    """A folder with a vehicle, a task that flies it, and one below that is based on the task."""
    (tmp_path / "below").mkdir()
    (tmp_path / "mine.toml").write_text(document.write(airframe("x500 base")).replace('name = "x500 base"\n', ""))
    write(tmp_path / "task.toml", 'based_on = "baseline"\nvehicle = "mine.toml"\n[reward.velocity]\nweight = 0.2')
    write(tmp_path / "below" / "child.toml", 'based_on = "../task.toml"\n[termination.speed]\nbound = 1.5')
    return tmp_path


def write(path, text):
    """The path of a new file with this text."""
    path.write_text(text + "\n")
    return path


def refusal(task, edits=None):
    """The line that a task is refused with."""
    with pytest.raises(BadInput) as caught:
        load_task(task, edits)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- paths ---


@pytest.mark.parametrize("where", [".", "below", "/"])
def test_a_vehicle_lies_beside_the_file_that_names_it_whatever_the_current_folder(folder, monkeypatch, where):
    monkeypatch.chdir(folder / where)
    for task in (folder / "task.toml", os.path.relpath(folder / "task.toml")):
        assert load_task(task).vehicle == airframe("x500 base").__class__(
            **{**vars(airframe("x500 base")), "name": "mine"}
        )


def test_a_file_may_be_based_on_another_file(folder, monkeypatch):
    monkeypatch.chdir("/")
    task = load_task(folder / "below" / "child.toml")
    assert (task.name, task.vehicle.mass, task.speed_bound) == ("child", 2.064308, 1.5)
    assert task.reward["velocity"].weight == 0.2
    assert task.sources["reward.velocity.weight"] == "set in task.toml"
    assert task.sources["termination.speed.bound"] == "set in child.toml"


def test_a_written_task_needs_no_other_file(folder):
    text = write_task(load_task(folder / "below" / "child.toml"))
    shutil.rmtree(folder / "below")
    (folder / "mine.toml").unlink()
    assert read_task_text(text, "task.toml").vehicle.mass == 2.064308


@pytest.mark.parametrize(
    "missing", ["mass", "inertia", "propeller_radius", "drag", "gravity", "motor_rise_time_constant", "action_scale"]
)
def test_what_a_vehicles_file_lacks_is_missing_and_not_taken_from_the_vehicle_of_the_base(folder, missing):
    path = folder / "mine.toml"
    lines = path.read_text().splitlines()
    write(path, "\n".join(line for line in lines if not line.startswith(missing)))
    assert f"vehicle.{missing}: missing" in refusal(folder / "task.toml")


def test_what_a_vehicles_file_may_leave_out_is_not_taken_from_the_vehicle_of_the_base(folder):
    assert load_task("baseline").vehicle.ground_effect is not None
    assert load_task(folder / "task.toml").vehicle.ground_effect is None


def test_a_vehicle_on_the_command_line_is_relative_to_the_current_folder(folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert load_task("baseline", {"vehicle": "mine.toml"}).vehicle.mass == 2.064308
    monkeypatch.chdir(folder / "below")
    assert load_task("child.toml", {"vehicle": "../mine.toml"}).vehicle.mass == 2.064308


@pytest.mark.parametrize("name", ["itself", "two files"])
def test_files_that_are_based_on_each_other_are_refused(tmp_path, name):
    first = write(tmp_path / "a.toml", f'based_on = "{"a" if name == "itself" else "b"}.toml"')
    write(tmp_path / "b.toml", 'based_on = "a.toml"')
    assert refusal(first) == f"{first}: based_on: leads back to {first}. Base one of these files on a preset."


def test_a_file_that_is_missing_is_named_with_the_file_that_names_it(tmp_path):
    vehicle = write(tmp_path / "v.toml", 'based_on = "baseline"\nvehicle = "gone.toml"')
    text = refusal(vehicle)
    assert text.startswith(f"{vehicle}: vehicle: {tmp_path / 'gone.toml'}: cannot be read (No such file or directory).")
    assert text.endswith("A path in a file is relative to the folder of that file.")
    base = write(tmp_path / "b.toml", 'based_on = "gone.toml"')
    assert refusal(base).startswith(f"{tmp_path / 'gone.toml'}: cannot be read")


def test_the_name_of_a_vehicle_file_without_its_ending_gets_a_hint(folder):
    text = refusal(write(folder / "short.toml", 'based_on = "baseline"\nvehicle = "mine"'))
    assert text.endswith("Did you mean mine.toml?")


def test_rotors_on_the_command_line_need_the_arm_removed():
    rotors = {"place": [[0.04, 0.0], [0.0, -0.04], [-0.04, 0.0], [0.0, 0.04]], "spin": [-1, 1, -1, 1]}
    assert refusal("baseline", {"vehicle.rotors": rotors}).endswith('Give one, and "none" for the other.')
    assert load_task("baseline", {"vehicle.rotors": rotors, "vehicle.arm": "none"}).vehicle.arm is None


def test_a_value_of_a_base_that_follows_a_dial_is_refused_too(tmp_path):
    write(tmp_path / "base.toml", 'based_on = "dial"\n[reward.velocity]\nsharpness = 3.0')
    text = refusal(write(tmp_path / "mine.toml", 'based_on = "base.toml"'))
    assert "reward.velocity.sharpness: 3.0 is not allowed, since it follows the dials" in text


# --- vehicles in part ---


def test_a_file_may_change_one_number_of_the_vehicle_of_its_base(tmp_path):
    task = load_task(write(tmp_path / "mine.toml", 'based_on = "baseline"\n[vehicle]\nmass = 0.035'))
    assert (task.vehicle.mass, task.vehicle.arm) == (0.035, 39.73e-3)
    assert task.vehicle.sources["mass"] == "set in mine.toml" and task.vehicle.sources["arm"] == "paper R5"


def test_a_complete_vehicle_keeps_nothing_of_the_base(tmp_path):
    table = document.plain(airframe("hummingbird x")) | {"sources": {}}
    text = "\n".join(f"{name} = {value!r}".replace("'", '"') for name, value in table.items() if name != "sources")
    task = load_task(write(tmp_path / "mine.toml", f'based_on = "baseline"\n[vehicle]\n{text}'))
    assert task.vehicle.name == "hummingbird x"
    assert task.vehicle.optional_rotor_drag is None and task.vehicle.ground_effect is None


def test_a_layout_of_rotors_takes_the_place_of_the_arm(tmp_path):
    rotors = "place = [[0.04, 0.0], [0.0, -0.04], [-0.04, 0.0], [0.0, 0.04]]\nspin = [-1, 1, -1, 1]"
    task = load_task(write(tmp_path / "mine.toml", f'based_on = "baseline"\n[vehicle.rotors]\n{rotors}'))
    assert task.vehicle.arm is None and task.vehicle.rotors is not None


# --- what is removed ---


@pytest.mark.parametrize("text", ["termination = {}", "[termination]", 'termination = "none"'])
def test_an_empty_table_of_terminations_removes_all(tmp_path, text):
    task = load_task(write(tmp_path / "mine.toml", f'based_on = "baseline"\n{text}'))
    assert task.termination == {} and len(task.reward) == 6
    assert read_task_text(write_task(task), "task.toml") == task


def test_an_empty_table_of_other_settings_changes_nothing(tmp_path):
    task = load_task(write(tmp_path / "mine.toml", 'based_on = "baseline-refined"\n[apg]\n[target]\n[noise]'))
    assert task.apg == load_task("baseline-refined").apg


@pytest.mark.parametrize("path", ["termination.speed", "reward.velocity", "reward.smoothness", "termination.distance"])
def test_an_entry_is_removed_by_the_word_none_in_a_file_and_on_the_command_line(tmp_path, path):
    table, name = path.split(".")
    file = write(tmp_path / "mine.toml", f'based_on = "baseline"\n[{table}]\n{name} = "none"')
    for task in (load_task(file), load_task("baseline", {path: "none"})):
        assert set(getattr(load_task("baseline"), table)) - set(getattr(task, table)) == {name}
        assert read_task_text(write_task(task), "task.toml") == task
    assert load_task("baseline", {"termination.speed": "none"}).speed_bound is None


def test_what_follows_a_dial_goes_with_the_term_or_bound_that_is_removed():
    task = load_task("dial", {"reward.velocity": "none", "termination.speed": "none"})
    assert not [path for path in task.follow if path.startswith(("reward.velocity", "termination.speed"))]
    assert "reward.horizontal.weight" in task.follow


@pytest.mark.parametrize(
    ("edits", "gone"),
    [
        ({"follow.termination.speed.bound": "none"}, "follow"),
        ({"input.setting": "none"}, "input"),
        ({"dial": "none", "follow": "none", "input": "none"}, "dial"),
        ({"dial": {}, "follow": {}, "input": {}}, "input"),
    ],
)
def test_dials_formulas_and_inputs_are_removed_likewise(edits, gone):
    assert len(getattr(load_task("dial", edits), gone)) < len(getattr(load_task("dial"), gone))


def test_an_optional_number_of_a_vehicle_is_removed_likewise():
    assert load_task("baseline", {"vehicle.optional_rotor_drag": "none"}).vehicle.optional_rotor_drag is None


@pytest.mark.parametrize(
    ("edits", "start"),
    [
        ({"termination.sped": "none"}, "termination.sped: there is none that could be removed. There are: altitude,"),
        ({"follow.reward.x.weight": "none"}, "follow.reward.x.weight: there is none that could be removed."),
        ({"reward": {}}, "reward: no term."),
        ({"reward": "none"}, "reward: no term."),
        ({"vehicle.mass": "none"}, "vehicle.mass: 'none' is not allowed. Allowed: above 0 kg."),
        ({"reward.velocity.weight": "none"}, "reward.velocity.weight: 'none' is not allowed."),
        ({"vehicle.arm": "none"}, "vehicle.arm: missing. Allowed: above 0 m, or a table [rotors]"),
    ],
)
def test_what_cannot_be_removed_is_refused(edits, start):
    assert refusal("baseline", edits).startswith(start)


def test_a_file_that_removes_what_its_base_does_not_have_is_refused(tmp_path):
    file = write(tmp_path / "mine.toml", 'based_on = "baseline"\n[termination]\nsped = "none"')
    assert refusal(file).startswith(f"{file}: termination.sped: there is none that could be removed.")
    assert refusal(file).endswith("Did you mean termination.speed?")


def test_an_edit_of_a_table_and_one_inside_it_both_count_in_any_order():
    for edits in (
        {"vehicle.mass": 0.04, "vehicle": "crazyflie-measured"},
        {"vehicle": "crazyflie-measured", "vehicle.mass": 0.04},
    ):
        vehicle = load_task("baseline", edits).vehicle
        assert (vehicle.mass, vehicle.motor_rise_time_constant) == (0.04, 0.136)


# --- hints ---


@pytest.mark.parametrize(
    ("path", "hint"),
    [
        ("termination.sped.bound", "termination.sped: is new here and has no kind. Did you mean termination.speed.b"),
        ("reward.velocty.weight", "reward.velocty: is new here and has no kind. Did you mean reward.velocity.weight?"),
        ("vehicle.arm_length", "vehicle.arm_length: no such field. Did you mean vehicle.arm (now 0.03973, allowed:"),
        ("velocity.weight", "velocity: no such field. Did you mean reward.velocity.weight?"),
        ("mass", "mass: no such field. Did you mean vehicle.mass?"),
        ("speed.bound", "speed: no such field. Did you mean termination.speed.bound?"),
        ("learning_rate", "learning_rate: no such field. Did you mean ppo.learning_rate or apg.learning_rate?"),
        ("apg.updatse", "apg.updatse: no such field. Did you mean apg.updates (now 200, allowed:"),
    ],
)  # fmt: skip
def test_a_wrong_path_is_led_to_the_right_one_at_the_level_where_it_is_wrong(path, hint):
    assert refusal("baseline", {path: 2.0}).startswith(hint)


@pytest.mark.parametrize("path", ["vehicle.rotor_directions", "reward.gloss.weight", "zzz.bound"])
def test_a_path_that_is_near_to_nothing_gets_no_hint(path):
    assert "Did you mean" not in refusal("baseline", {path: 2.0})
