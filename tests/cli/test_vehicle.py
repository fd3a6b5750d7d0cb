"""`flytune vehicle`: what it prints and writes, and what training says of a file that is not complete."""

import json
import tomllib

import pytest
from tests.command import refused
from tests.simulation.reading import models

from flytune.cli.main import main
from flytune.config import document
from flytune.physics.vehicle import load_vehicle, vehicle_names


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a model of Gazebo, which is complete, and one of gym-pybullet-drones, which lacks the lag."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gazebo.sdf").write_text(models.sdf())
    (tmp_path / "model.usd").write_text("#usda 1.0")
    (tmp_path / "bullet.urdf").write_text(models.urdf(properties='kf="1e-8" km="2e-10" thrust2weight="3"'))
    return tmp_path


def said(capsys, *arguments):
    """Standard output and errors of a command that succeeds."""
    capsys.readouterr()
    assert main(list(map(str, arguments))) == 0
    return capsys.readouterr()


@pytest.mark.parametrize("name", vehicle_names())
def test_a_vehicle_that_ships_is_printed_and_read_back_as_it_is(name, tmp_path, capsys):
    printed = said(capsys, "vehicle", name)
    assert printed.err == ""
    (tmp_path / f"{name}.toml").write_text(printed.out)
    assert load_vehicle(str(tmp_path / f"{name}.toml")) == load_vehicle(name)


def test_a_file_of_another_program_becomes_a_vehicle_with_the_same_numbers(here, capsys):
    printed = said(capsys, "vehicle", "gazebo.sdf", "--out", "mine.toml")
    assert printed.out == "mine.toml\n" and printed.err == ""
    told = json.loads(said(capsys, "vehicle", "gazebo.sdf", "--json").out)
    vehicle = document.plain(load_vehicle("mine.toml"))
    assert {name: vehicle[name] for name in told["vehicle"]} == told["vehicle"]
    assert vehicle["sources"] == told["sources"] and told["missing"] == {}
    assert set(told["units"]) == set(told["vehicle"]) - {"rotors"}
    assert told["units"]["thrust_coefficient"] == "N/rpm^2" and told["units"]["rotor_drag"] == "kg/rad"
    assert {"name": "mass", "value": 1.04, "unit": "kg", "usual": [0.02, 25]} in told["figures"]


def test_every_number_is_printed_with_its_unit_and_source(here, capsys):
    text = said(capsys, "vehicle", "gazebo.sdf").out
    assert "mass = 1.04 # kg\n" in text and "motor_rise_time_constant = 0.0125 # s\n" in text
    assert 'motor_rise_time_constant = "gazebo.sdf, timeConstantUp"' in text
    table = tomllib.loads(text)
    assert set(table["sources"]) == set(table) - {"sources"}
    assert "# thrust to weight of the motors 3.1" in text
    assert "# assumed: drag = [0.0, 0.0, 0.0]; to measure it: " in text


def test_what_the_file_lacks_is_named_with_how_to_measure_it_and_training_says_that_it_is_missing(here, capsys):
    printed = said(capsys, "vehicle", "bullet.urdf", "--out", "mine.toml")
    lacking = ["propeller_radius", "motor_rise_time_constant", "motor_fall_time_constant"]
    assert [line.split(": ")[1] for line in printed.err.splitlines()] == lacking
    text = (here / "mine.toml").read_text()
    for name in lacking:
        assert f"\n# {name} =  # " in text and f"\n{name} =" not in text
    assert "propeller_radius: missing" in refused("train", "baseline", "--set", "vehicle=mine.toml", capsys=capsys)
    # the file itself says what is still missing, and is whole once it is filled in
    assert said(capsys, "vehicle", "mine.toml").err.count("missing: ") == 3
    for name, value in zip(lacking, ("0.06", "0.02", "0.03"), strict=True):
        text = text.replace(f"# {name} = ", f"{name} = {value}")
    (here / "mine.toml").write_text(text)
    assert said(capsys, "vehicle", "mine.toml").err == ""
    assert load_vehicle("mine.toml").motor_fall_time_constant == 0.03


def test_a_model_where_a_vehicle_is_wanted_is_led_to_this_command(here, capsys):
    line = refused("train", "baseline", "--set", "vehicle=gazebo.sdf", capsys=capsys)
    assert "Make a vehicle of it: flytune vehicle gazebo.sdf --out mine.toml" in line


def test_a_file_that_flytune_did_not_write_is_not_replaced(here, capsys):
    (here / "notes.toml").write_text("mine = true\n")
    assert "notes.toml is there and is not a vehicle file" in refused(
        "vehicle", "gazebo.sdf", "--out", "notes.toml", capsys=capsys
    )
    assert (here / "notes.toml").read_text() == "mine = true\n"
    said(capsys, "vehicle", "gazebo.sdf", "--out", "mine.toml")
    said(capsys, "vehicle", "crazyflie", "--out", "mine.toml")
    assert load_vehicle("mine.toml").mass == 0.033


def test_nothing_is_written_of_a_file_that_is_refused(here, capsys):
    (here / "bad.sdf").write_text(models.sdf(motors=""))
    (here / "slip.urdf").write_text(models.urdf(properties='kf="1e-6" km="2e-8" thrust2weight="3" prop_radius="0.06"'))
    for file, line in (
        ("bad.sdf", "has no motors"),
        ("slip.urdf", "thrust_coefficient"),
        ("none.sdf", "cannot be read"),
    ):
        assert line in refused("vehicle", file, "--out", "mine.toml", capsys=capsys)
        assert not (here / "mine.toml").exists()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["gazebo.sdf", "--out", "mine.txt"], "out: mine.txt is not allowed. Allowed: a name that ends in .toml"),
        (["gazebo.sdf", "--out", "none/mine.toml"], "out: none is no folder"),
        (["crazyfly"], "'crazyfly' is no vehicle. Allowed: crazyflie, "),
        (["none.toml"], "none.toml: cannot be read"),
        (["model.usd"], "vehicle: model.usd is not allowed. Allowed: a file .toml, .urdf, .sdf or .xml, or a name."),
        (["gazebo.sdf", "--set"], "--set: is no option of vehicle"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(here, capsys, arguments, line):
    assert line in refused("vehicle", *arguments, capsys=capsys)
