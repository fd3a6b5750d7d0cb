"""`flytune judge` as a user meets it: what it prints, and one line with a remedy for what it cannot use."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from tests.command import flytune, refused
from tests.evaluation.logs import TIME, flown, plain, written

from flytune.cli.main import main

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "judge.md").read_text(encoding="utf-8")
X, Y, Z, YAW = flown()
STILL = (0 * TIME, 0 * TIME, 1 + 0 * TIME, 0 * TIME)


def test_the_commands_and_the_script_of_the_page_run_one_after_the_other(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("flight.csv", "first.csv", "second.csv"):
        plain(tmp_path / name)
    commands = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^    (flytune .*)$", PAGE, re.MULTILINE)]
    assert len(commands) == 5
    own = written(tmp_path / "own.csv", "stamp,north,east,down", TIME * 1e3, X * 1e3, -Y, -Z)
    for command in commands:
        if any(word.startswith("time=stamp") for word in command):
            command[1] = own
        assert main([*command, *(["--trials", "3"] if command[0] == "evaluate" else [])]) == 0
    said = capsys.readouterr()
    tables = said.out.split("crashed 0")
    assert tables[0] == tables[1].partition("\n")[2].partition("\n")[2].partition("\n")[2]  # the same table again
    assert "own.csv: 801 rows" in said.err
    (script,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(script, "judge.md", "exec"), {})  # the page's own words
    assert "log: 1 flight of 7.98 s" in capsys.readouterr().out


def test_json_is_one_object_on_standard_output_and_what_was_taken_is_on_standard_error(tmp_path):
    answer = flytune("judge", plain(tmp_path / "log.csv"), "--target", "-1,0,1,0", "--json", cwd=tmp_path)
    judged = json.loads(answer.stdout)
    assert judged["who"].endswith("log.csv") and judged["trials"] == 1 and judged["duration"] == 8.0
    assert judged["position"]["settled"] == 0 and judged["axes"]["y"]["settled"] == 1
    assert "time = t [s], x = x [m]" in answer.stderr and "taken as it is" in answer.stderr


def rows(path, header, *columns, replace=None):
    written(path, header, *columns)
    if replace:
        lines = path.read_text().splitlines()
        lines[replace[0]] = replace[1]
        path.write_text("\n".join(lines))


BACK, GAP = TIME.copy(), np.abs(TIME - 4) > 0.75
BACK[300:] -= 1
HEADER, TO = "t,x,y,z,yaw", ["--target", "0,0,1,0"]
TARGETS = f"{HEADER},target_x,target_y,target_z,target_yaw"
LOG = (HEADER, TIME, X, Y, Z, YAW)
LONG = [0.5 * np.arange(4001), *(np.repeat(each, 5)[:4001] for each in (X, Y, Z, YAW))]
WRONG = {  # what is in the file, further arguments, what is said, and where there is one: the remedy that then works
    "no target": (LOG, [], "no column is a target. Give --target x,y,z,yaw", TO),
    "no yaw": (("t,x,y,z", TIME, X, Y, Z), TO, r"no column is yaw. Found: t, x, y, z. Give .*yaw=0\.",
               ["--columns", "yaw=0"]),
    "other names": (("a,b,c,d,e", TIME, X, Y, Z, YAW), TO, "no column is time, x, y, z, yaw. Found: a, b, c, d, e",
                    ["--columns", "time=a[s]", "x=b", "y=c", "z=d", "yaw=e"]),
    "two that fit": (("t,pos.x,pos_x,y,z,pos_y,pos_z,yaw", TIME, X, X, Y, Z, Y, Z, YAW), TO,
                     "pos.x and pos_x both fit. Give --columns 'x=pos.x'", ["--columns", "x=pos.x", "y=y", "z=z"]),
    "degrees": ((HEADER, TIME, X, Y, Z, np.degrees(YAW)), TO, r"yaw goes to 45.84, .* Give --columns 'yaw=yaw\[UNIT\]'",
                ["--columns", "yaw=yaw[deg]"]),
    "millimetres": ((HEADER, TIME, X * 1e3, Y, Z, YAW), TO, r"x goes to 1000, and nothing says its unit",
                    ["--columns", "x=x[mm]"]),
    "3 Hz": ((HEADER, TIME * 30, X, Y, Z, YAW), TO, r"no sample from .* \(0.30 s\).*Give --gap 0.31",
             ["--gap", "0.31"]),
    "2 Hz in milliseconds": (("Timestamp,x,y,z,yaw", TIME[::50] * 1e3, X[::50], Y[::50], Z[::50], YAW[::50]), TO,
                             r"no sample from 0.00 to 0.50 s .*Give --gap 0.51", ["--gap", "0.51"]),
    "1 Hz": (("Timestamp,x,y,z,yaw", TIME[::100], X[::100], Y[::100], Z[::100], YAW[::100]), TO,
             r"a step of 1 .* fits no unit for sure \(in s it is 1 Hz for 8 s; in ms it is 1000 Hz for 0.008 s",
             ["--columns", "time=Timestamp[s]", "--gap", "1"]),
    "2 Hz or 2 kHz": (("Timestamp,x,y,z,yaw", *LONG), TO,
                      r"fits no unit for sure \(in s it is 2 Hz for 2000 s; in ms it is 2000 Hz for 2 s\)",
                      ["--columns", "time=Timestamp[ms]", "--gap", "1"]),
    "a gap": ((HEADER, *(each[GAP] for each in (TIME, X, Y, Z, YAW))), TO,
              r"no sample from 3.24 to 4.76 s .*Give --gap 1.53", ["--gap", "1.53"]),
    "a time that goes back": ((HEADER, BACK, X, Y, Z, YAW), TO, r"goes back from 2.99 to 2 s \(sample 301\)", None),
    "too short": ((HEADER, *(each[:150] for each in (TIME, X, Y, Z, YAW))), TO, "lasts 1.49 s after its start", None),
    "a late start": (LOG, [*TO, "--start", "7"], r"lasts 1.00 s .* an earlier --start",
                     ["--start", "6"]),
    "after the end": (LOG, [*TO, "--start", "70"], r"a start up to 6.00 s", ["--start", "6.00"]),
    "a quaternion in another order": (("t,x,y,z,qx,qy,qz,qw", TIME, X, Y, Z, X, X, X, X + 1), TO, "the norm .*: 1",
                                      None),
    "a target that moves": ((TARGETS, TIME, X, Y, Z, YAW, *STILL[:2], Z, YAW), [],
                            r"changes \d+ times, so that it follows a path", TO),
    "a word": ((*LOG, (5, "0.04,oops,0,0,0")), TO, "row 6, column x: 'oops' is no number", None),
    "a short row": ((*LOG, (5, "0.04,1")), TO, "row 6 has fewer cells than the header", None),
    "decimal commas between commas": ((*LOG, (5, "0,04,1,0,0,0,1,0")), TO, "decimals have commas", None),
    "no rows": ((HEADER,), TO, "has a header and no row", None),
    "a column that is not there": (LOG, [*TO, "--columns", "x=foo"],
                                   "has no column 'foo'. Allowed: t, x, y, z, yaw; or a number", ["--columns", "x=x"]),
    "a quantity that is not there": (LOG, [*TO, "--columns", "speed=x"],
                                     "'speed' is not allowed. Allowed: time, x", None),
    "a unit that is not there": (LOG, [*TO, "--columns", "x=x[inch]"],
                                 "the unit 'inch' is not allowed. Allowed: m, cm, mm, ft", ["--columns", "x=x[m]"]),
    "a unit of the header": (("t,x [parsec],y,z,yaw", *LOG[1:]), TO, "the unit 'parsec' is not allowed", None),
    "degrees in the target": (LOG, ["--target", "0,0,1,90"], "Did you mean 1.571",
                              ["--target", "0,0,1,1.571"]),
    "three numbers": (LOG, ["--target", "0,0,1"], "four numbers x,y,z,yaw", TO),
    "no numbers": (LOG, ["--target", "here"], "four numbers x,y,z,yaw", TO),
    "a negative start": (LOG, [*TO, "--start=-1"], "start: -1.0 is not allowed", ["--start", "0"]),
    "no gap at all": (LOG, [*TO, "--gap", "0"], "gap: 0.0 is not allowed", ["--gap", "0.1"]),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_log_that_cannot_be_used_is_one_line_and_what_it_says_to_give_works(tmp_path, capsys, case):
    (header, *columns), arguments, reason, remedy = WRONG[case]
    replace = columns.pop() if columns and isinstance(columns[-1], tuple) else None
    path = tmp_path / "log.csv"
    rows(path, header, *columns, replace=replace)
    said = refused("judge", path, *arguments, capsys=capsys)
    assert re.search(reason, said), said
    if remedy:
        assert main(["judge", str(path), *arguments, *remedy]) == 0


FILES = {
    "empty.csv": (b"", "is empty. Allowed: a header"),
    "blank.csv": (b"\n\n", "is empty"),
    "flight.ulg": (b"ULog\x01\x12\x35\x00" * 10, "is no text. Allowed: a .csv log, or an .npz file"),
    "words.csv": (b"hello\nworld\n", "has one column, 'hello'"),
    "junk.npz": (b"PK\x03\x04 and nothing else", "is no file of flights"),
    "folder": (None, "cannot be read (Is a directory)"),
    "missing.csv": (None, "cannot be read (No such file or directory)"),
}


@pytest.mark.parametrize("name", FILES)
def test_what_is_no_log_is_refused_in_one_line(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    content, reason = FILES[name]
    if content is not None:
        Path(name).write_bytes(content)
    elif name == "folder":
        Path(name).mkdir()
    said = refused("judge", name, *TO, capsys=capsys)
    assert said.startswith(f"{name}: {reason}")


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path, capsys):
    with (tmp_path / "huge.csv").open("wb") as file:
        file.write(b"t,x,y,z,yaw\n")
        file.truncate(3_000_000_000)  # a hole, which takes no space
    assert "has 3.0 GB. Allowed: 2 GB" in refused("judge", tmp_path / "huge.csv", *TO, capsys=capsys)


ARRAYS = {"time": TIME, "position": np.stack([X, Y, Z], axis=-1), "yaw": YAW, "target_position": [0.0, 0.0, 1.0]}
NPZ = {
    "no yaw": ({"yaw": None}, "has no array yaw. Found: time, position, target_position"),
    "no target": ({"target_position": None}, "position, yaw. Give --target x,y,z,yaw in m and rad."),
    "words": ({"yaw": np.array(["a"] * 801)}, "yaw holds <U1, not numbers"),
    "objects": ({"yaw": np.array([{}] * 801)}, "is no file of flights (Object arrays cannot be loaded"),
    "another length": ({"yaw": YAW[:-1]}, "yaw: the shape (1, 800, 1) is not allowed with time (801,)"),
    "half of ours": ({"data": np.zeros((1, 2, 3)), "columns": np.array(["a", "b", "c"])}, "is no file of flights"),
}


@pytest.mark.parametrize("case", NPZ)
def test_arrays_that_cannot_be_used_are_refused_in_one_line(tmp_path, capsys, case):
    changes, reason = NPZ[case]
    np.savez(tmp_path / "own.npz", **{name: each for name, each in (ARRAYS | changes).items() if each is not None})
    assert reason in refused("judge", tmp_path / "own.npz", capsys=capsys)


@pytest.mark.parametrize("target", ["0,0,1,0", "[0, 0, 1, 0]", "0 0 1 0"])
def test_arrays_without_a_target_are_judged_by_the_one_that_is_given(tmp_path, capsys, target):
    np.savez(tmp_path / "own.npz", **{name: each for name, each in ARRAYS.items() if name != "target_position"})
    assert main(["judge", str(tmp_path / "own.npz"), "--target", target, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["position"]["settled"] == 1


def test_flights_that_hold_their_target_take_no_other_and_no_columns(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "pid", "--trials", "1", "--duration", "1", "--flights", "f.npz"]) == 0
    for option, value in (("target", "0,0,1,0"), ("start", "1"), ("columns", "x=y")):
        said = refused("judge", "f.npz", f"--{option}", value, capsys=capsys)
        assert f"{option}: " in said and f"Leave out --{option}" in said
    assert main(["judge", "f.npz"]) == 0


@pytest.mark.parametrize(
    ("name", "guessed"), [("yaw", True), ("yaw[rad]", False), ("yaw_rad", False), ("yaw [deg]", False)]
)
def test_an_angle_whose_unit_nothing_says_is_named_with_the_way_to_say_it(tmp_path, monkeypatch, capsys, name, guessed):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "log.csv", f"t,x,y,z,{name}", TIME, X, Y, Z, YAW)
    assert main(["judge", "log.csv", "--target", "0,0,1,0"]) == 0
    said = capsys.readouterr().err
    assert ("taken as rad. For degrees, give --columns 'yaw=yaw[deg]'" in said) == guessed


@pytest.mark.parametrize(
    ("unit", "factor", "rate"),
    [("s", 1.0, 5), ("ms", 1e3, 4), ("ms", 1e3, 1000), ("us", 1e6, 250), ("ns", 1e9, 100), ("us", 1e6, 2)],
)
def test_the_unit_of_time_that_nothing_says_is_the_plausible_one_and_is_told(tmp_path, capsys, unit, factor, rate):
    time = np.arange(0, 8 + 1e-9, 1 / rate)
    written(tmp_path / "log.csv", "Timestamp,x,y,z,yaw", 1e5 + time * factor, *flown(time))
    assert main(["judge", str(tmp_path / "log.csv"), *TO, "--gap", "0.6"]) == 0
    said = capsys.readouterr()
    assert f"time = Timestamp [{unit}]" in said.err and "1 flight of 8 s" in said.out
    assert (f"taken as {unit}, in which" in said.err) == (unit != "s")
