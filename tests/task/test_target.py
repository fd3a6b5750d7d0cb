"""Targets that move: places, headings, what they need of a vehicle, and what is refused."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flytune.errors import BadInput
from flytune.physics import rotation
from flytune.task.files import load_task, read_task_text, write_task
from flytune.task.observation import ObservationNoise, observe
from flytune.task.paths import Circle, Helix, Lemniscate
from flytune.task.target import Point, sampled, target_at
from flytune.task.waypoints import Waypoints

GRAVITY = 9.81
NODES = {"times": (0.0, 2.0, 5.0), "positions": ((0.0, 0.0, 1.0), (1.0, 0.5, 1.2), (0.0, 1.0, 1.0))}
PATHS = {
    "circle": Circle(radius=0.7, speed=1.3),
    "circle along": Circle(radius=0.7, speed=1.3, facing="along_path", yaw=0.3),
    "lemniscate": Lemniscate(half_width=0.8, speed=1.1),
    "lemniscate along": Lemniscate(half_width=0.8, speed=1.1, facing="along_path"),
    "helix": Helix(radius=0.6, speed=0.9, climb_per_turn=0.5),
    "smooth": Waypoints(**NODES, yaws=(0.0, 1.0, 0.5), interpolation="smooth"),
}
CIRCLE = {"target.kind": "circle"}


def refused(edits, task="baseline"):
    with pytest.raises(BadInput) as caught:
        load_task(task, edits)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture(scope="module")
def reference():
    """The reference of a path at a time, compiled."""
    return jax.jit(lambda path, time: path.reference(time, GRAVITY))


def test_a_target_without_a_kind_is_a_point():
    text = write_task(load_task("baseline")).replace('kind = "point"\n', "")
    assert 'kind = "point"' not in text
    assert read_task_text(text, "old").target == Point(position=(0.0, 0.0, 1.0), yaw=0.0)


@pytest.mark.parametrize("name", PATHS)
def test_what_a_path_asks_for_is_the_derivative_of_where_it_is(name, reference):
    # central differences of positions in double precision, and of the attitudes that they need
    path, h = PATHS[name], 1e-3
    for time in (0.4, 1.7, 3.1):
        found = reference(path, time)
        grid = time + h * np.arange(-2, 3)
        place, yaw = sampled(path, grid)
        np.testing.assert_allclose(np.array(found.position), place[2], atol=1e-5)
        assert float(found.yaw) == pytest.approx(yaw[2], abs=1e-5)
        np.testing.assert_allclose(np.array(found.motion.velocity), (place[3] - place[1]) / (2 * h), atol=1e-4)
        thrust = np.diff(place, 2, axis=0) / h**2 + [0, 0, GRAVITY]
        up = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
        attitudes = [with_axis(*each) for each in zip(up, yaw[1:4], strict=True)]
        seen = Rotation.from_quat(np.array(found.motion.attitude))
        assert (seen.inv() * attitudes[1]).magnitude() < 1e-4
        rate = (attitudes[0].inv() * attitudes[2]).as_rotvec() / (2 * h)
        np.testing.assert_allclose(np.array(found.motion.body_rate), rate, atol=3e-3)


def with_axis(up, yaw):
    """The attitude whose z axis and ZYX yaw these are: x lies in the vertical plane of the heading."""
    left = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    forward = np.cross(left, up) / np.linalg.norm(np.cross(left, up))
    return Rotation.from_matrix(np.stack([forward, np.cross(up, forward), up], axis=-1))


def test_a_circle_keeps_its_radius_and_speed_and_begins_at_plus_x(reference):
    path = Circle(centre=(1.0, 2.0, 3.0), radius=2.0, speed=0.5)
    np.testing.assert_allclose(np.array(path.position), [3, 2, 3])
    quarter = reference(path, math.pi / 2 * 2.0 / 0.5)
    np.testing.assert_allclose(np.array(quarter.position), [1, 4, 3], atol=1e-5)
    np.testing.assert_allclose(np.array(quarter.motion.velocity), [-0.5, 0, 0], atol=1e-5)  # anticlockwise


def test_the_largest_speed_of_a_lemniscate_is_its_speed_and_its_width_is_kept():
    time = np.linspace(0, 40, 40001)
    place, _ = sampled(Lemniscate(half_width=1.5, speed=0.6), time)
    assert np.linalg.norm(np.diff(place, axis=0), axis=1).max() / 1e-3 == pytest.approx(0.6, rel=1e-3)
    assert np.abs(place[:, 0]).max() == pytest.approx(1.5, rel=1e-3)


def test_a_helix_climbs_by_its_height_in_a_turn_at_its_speed_along_the_path():
    helix = Helix(radius=1.0, speed=0.5, climb_per_turn=-0.2)
    turn = math.hypot(2 * math.pi, 0.2) / 0.5  # s: length over speed
    first, last = (np.array(target_at(helix, time).position) for time in (0.0, turn))
    np.testing.assert_allclose(last - first, [0, 0, -0.2], atol=1e-6)


@pytest.mark.parametrize("name", ["circle along", "lemniscate along"])
def test_along_the_path_the_heading_is_the_direction_of_flight_and_the_given_yaw_beside_it(name, reference):
    path = PATHS[name]
    found = reference(path, 1.234)
    vx, vy, _ = found.motion.velocity
    assert math.remainder(float(found.yaw) - path.yaw - math.atan2(vy, vx), 2 * math.pi) == pytest.approx(0, abs=1e-5)


def test_steps_jump_at_their_times_and_rest_between_them(reference):
    path = Waypoints(**NODES, yaws=(0.0, 1.0, 2.0), yaw=0.5)
    for time, place in ((0.0, 0), (1.99, 0), (2.0, 1), (4.99, 1), (5.0, 2), (100.0, 2)):
        found = reference(path, time)
        np.testing.assert_allclose(np.array(found.position), NODES["positions"][place], atol=1e-6)
        assert float(found.yaw) == pytest.approx(0.5 + place)
        assert found.motion is None


def test_a_smooth_path_passes_its_waypoints_begins_and_ends_at_rest_and_stays(reference):
    path = PATHS["smooth"]
    for time, place in zip(NODES["times"], NODES["positions"], strict=True):
        np.testing.assert_allclose(np.array(reference(path, time).position), place, atol=1e-5)
    for time in (0.0, 5.0, 9.0):
        np.testing.assert_allclose(np.array(reference(path, time).motion.velocity), 0, atol=1e-4)
    np.testing.assert_allclose(np.array(reference(path, 9.0).position), NODES["positions"][-1], atol=1e-5)


def test_many_waypoints_are_looked_up_to_the_same_place_as_few(reference):
    times = np.arange(0, 6.01, 0.05)
    circle = Circle()
    places = [tuple(map(float, row)) for row in sampled(circle, times)[0]]
    many = Waypoints(times=tuple(times), positions=tuple(places), interpolation="smooth", ends="free")
    for time in (0.0, 1.23, 5.9):
        found, exact = reference(many, time), reference(circle, time)
        np.testing.assert_allclose(np.array(found.position), np.array(exact.position), atol=1e-5)
        np.testing.assert_allclose(np.array(found.motion.velocity), np.array(exact.motion.velocity), atol=1e-3)


@pytest.mark.parametrize("name", PATHS)
def test_a_vehicle_in_the_state_of_the_reference_is_seen_as_one_that_hovers_at_its_target(name, reference):
    from flytune.physics.dynamics import State

    target = reference(PATHS[name], 1.1)
    state = State(
        position=target.position,
        attitude=target.motion.attitude,
        velocity=target.motion.velocity,
        body_rate=target.motion.body_rate,
        rotor_speed_rpm=(jnp.float32(15000),) * 4,
        pending_actions=jnp.zeros((0, 4)),
    )
    quiet = ObservationNoise(position=0.0, attitude=0.0, velocity=0.0, body_rate=0.0)
    seen = observe(target, quiet, state, jnp.zeros(4), jnp.zeros(13))
    np.testing.assert_allclose(seen, [0, 0, 0, 0, 0, 0, 1, *[0] * 10], atol=2e-6)


def test_without_feed_forward_the_attitude_is_seen_from_the_level_heading():
    path = Circle(feed_forward=False, facing="along_path")
    found = path.reference(1.0, GRAVITY)
    roll, pitch = rotation.roll_pitch(found.motion.attitude)
    assert float(roll) == pytest.approx(0, abs=1e-6)
    assert float(pitch) == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(np.array(found.motion.body_rate), [0, 0, 0.5], atol=1e-5)


@pytest.mark.parametrize("edits", [
    CIRCLE, {"target.kind": "helix", "target.climb_per_turn": 0.1}, {"target.kind": "lemniscate"},
    {"target.kind": "waypoints", "target.times": [0, 3], "target.positions": [[0, 0, 1], [1, 0, 1]]},
])  # fmt: skip
def test_a_path_is_written_and_read_again_exactly(edits):
    edits = {path: [[float(x) for x in row] for row in value] if path.endswith("positions") else value
             for path, value in edits.items()}  # fmt: skip
    task = load_task("baseline", edits)
    again = read_task_text(write_task(task), "again")
    assert again.target == task.target
    assert write_task(again) == write_task(task)


def test_another_kind_keeps_the_place_and_the_heading_and_loses_the_papers_source():
    task = load_task("baseline", {"target.position": [1.0, 2.0, 1.5], "target.yaw": 0.5, **CIRCLE})
    assert task.target == Circle(centre=(1.0, 2.0, 1.5), yaw=0.5)
    assert "target" not in task.sources
    back = load_task("baseline", {**CIRCLE})
    assert "paper" not in write_task(back).partition("[target]")[2].partition("[initial_state]")[0]


@pytest.mark.parametrize(("edits", "told"), [
    ({**CIRCLE, "target.speed": 0.9}, "a path faster than the bounds allow"),
    ({"target.kind": "lemniscate", "target.speed": 0.81}, "termination.speed.bound is 0.8 m/s"),
    ({"target.kind": "helix", "target.climb_per_turn": -3.0}, "termination.altitude.bound is 0.1 m"),
    ({**CIRCLE, "target.speed": 6.0, "termination.speed": "none", "target.radius": 0.5}, "termination.body_rate"),
    ({**CIRCLE, "target.speed": 8.0, "termination.speed": "none", "target.radius": 2.0}, "times the weight"),
    ({**CIRCLE, "target.speed": 2.0, "termination.speed": "none",
      "termination.tilt": {"kind": "maximum_tilt", "bound_deg": 15.0}}, "a tilt of 22.2 deg"),
    ({"target.kind": "cirlce"}, "Did you mean circle?"),
    ({**CIRCLE, "target.position": [0.0, 0.0, 2.0]}, "Write target.centre"),
    ({"target.kind": "waypoints"}, "0 waypoints"),
    ({"target.kind": "waypoints", "target.times": [0, 2], "target.positions": [[0.0, 0, 1]]}, "1 for 2 times"),
    ({"target.kind": "waypoints", "target.times": [0, 3, 2], "target.positions": [[0.0, 0, 1]] * 3}, "rising times"),
    ({"target.kind": "waypoints", "target.times": [1, 3], "target.positions": [[0.0, 0, 1]] * 2}, "first time"),
    ({"target.kind": "waypoints", "target.times": [0, 0.1], "target.positions": [[0.0, 0, 1]] * 2}, "lasts 0.1 s"),
    ({"target.kind": "waypoints", "target.times": [0], "target.positions": [[0.0, 0, 1]], "target.table": [1]},
     "leave it out"),
    ({"target.kind": "csv"}, "target.file: missing"),
])  # fmt: skip
def test_a_path_that_cannot_be_flown_or_read_is_refused_in_one_line(edits, told):
    assert told in refused(edits)


def test_the_speed_that_a_refusal_names_is_accepted():
    said = refused({**CIRCLE, "target.speed": 0.9})
    speed = float(said.partition("target.speed=")[2].partition(",")[0])
    assert load_task("baseline", {**CIRCLE, "target.speed": speed}).target.speed == pytest.approx(0.8, rel=1e-3)


@pytest.mark.parametrize(("rows", "told"), [
    ("0,0,0,1\n0.1,0,,1\n0.2,0,0,1", "row 3: y: '' is no number"),
    ("0,0,0,1\n0.1,0,0\n0.2,0,0,1", "row 3: z"),
    ("0,0,0,1\n0.1,0,nan,1\n", "row 3: y"),
    ("0,0,0,1\n0.2,0,0,1\n0.1,0,0,1", "row 4: t goes from 0.2 to 0.1 s"),
    ("0,0,0,1\n0.1,0,0,1\n0.2,0,0,1\n3,0,0,1\n3.1,0,0,1", "no sample for 2.8 s"),
    ("0,0,0,1", "has 1 rows"),
    ("", "has 0 rows"),
])  # fmt: skip
def test_a_csv_that_holds_no_path_is_refused_with_its_row(tmp_path, rows, told):
    file = tmp_path / "path.csv"
    file.write_text(f"t,x,y,z\n{rows}\n")
    assert told in refused({"target.kind": "csv", "target.file": str(file)})


def test_a_csv_without_a_column_is_refused(tmp_path):
    file = tmp_path / "path.csv"
    file.write_text("time,x,y\n0,0,0\n1,0,0\n")
    assert "has no column t, z" in refused({"target.kind": "csv", "target.file": str(file)})


def test_a_csv_lies_beside_its_task_file_and_the_task_holds_its_numbers(tmp_path):
    rows = [f"{10 + 0.1 * k:.1f};{0.02 * k:.2f};0;1;{170 if k < 5 else -170}".replace(";", ",") for k in range(11)]
    (tmp_path / "path.csv").write_text("T, X ,y,z,yaw\n" + "\n".join(rows))
    (tmp_path / "task.toml").write_text('based_on = "baseline"\n[target]\nkind = "csv"\nfile = "path.csv"\n'
                                        'interpolation = "smooth"\nends = "at_rest"\n')  # fmt: skip
    with pytest.raises(BadInput, match=r"row 2: yaw: 170 .* in deg"):
        load_task(tmp_path / "task.toml")
    text = (tmp_path / "path.csv").read_text().replace(",170", ",3.1").replace(",-170", ",-3.1")
    (tmp_path / "path.csv").write_text(text)
    target = load_task(tmp_path / "task.toml").target
    assert target.times[0] == 0
    assert target.times[-1] == pytest.approx(1.0)
    assert np.ptp(target.yaws) == pytest.approx(2 * math.pi - 6.2)  # the short way round
    assert read_task_text(write_task(load_task(tmp_path / "task.toml")), "again").target == target
