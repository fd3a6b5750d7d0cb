"""What every classical controller must do: rest at the target, reach it, keep its limits, and read its gains."""

import math
import tomllib
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import flytune
from flytune.config.document import plain, read
from flytune.control.classical import CLASSICAL, classical_controller, read_gains
from flytune.control.controller import Controller
from flytune.control.sensing import heading
from flytune.errors import BadInput
from flytune.physics.rotation import from_euler
from flytune.task.files import load_task

SETS = ("textbook", "tuned")
EVERY = [(name, gains) for name in CLASSICAL for gains in SETS]


@pytest.fixture(params=EVERY, ids="-".join)
def controller(request, baseline):
    """Every controller with either set of gains, for the baseline."""
    return classical_controller(request.param[0], baseline, request.param[1])


@jax.jit
def first_action(controller, seen):
    """What a controller does about its first observation."""
    return controller.act(controller.initial_memory(), seen)[1]


# --- at the target ---


def test_at_the_target_the_action_is_hover(controller, baseline, observation):
    assert isinstance(controller, Controller)
    action = first_action(controller, observation(baseline))
    # float32: the allocation's squares carry 1e-7, and attitude errors of 1e-7 times gains of 1e3
    np.testing.assert_allclose(action, 0, atol=1e-4)


@pytest.mark.parametrize("yaw", [-3.0, 0.7, math.pi])
@pytest.mark.parametrize("name", CLASSICAL)
def test_at_a_target_with_a_heading_the_action_is_hover(name, yaw, observation):
    task = load_task("baseline", {"target.yaw": yaw})
    controller = classical_controller(name, task)
    action = first_action(controller, observation(task, angles=(0, 0, yaw)))
    np.testing.assert_allclose(action, 0, atol=2e-4)


@pytest.mark.parametrize(
    ("moved", "signs"),
    [
        ({"position": (0, 0, 0.5)}, (1, 1, 1, 1)),  # too low: all rotors faster
        ({"position": (-0.5, 0, 1)}, (-1, 1, 1, -1)),  # behind the target: pitch nose down, positive about y
        ({"position": (0, 0.5, 1)}, (-1, -1, 1, 1)),  # left of it: roll to the right, positive about x
        ({"angles": (0, 0, -0.5)}, (-1, 1, -1, 1)),  # turned to the right: yaw to the left, positive about z
        ({"angles": (-0.1, 0, 0)}, (-1, -1, 1, 1)),
        ({"body_rate": (0, -1, 0)}, (-1, 1, 1, -1)),
    ],
)
def test_the_action_works_against_the_error(controller, baseline, observation, moved, signs):
    action = first_action(controller, observation(baseline, **moved))
    assert np.all(np.sign(action) == signs), action


# --- on the way ---


@pytest.mark.parametrize(("name", "gains"), EVERY)
def test_every_start_ends_at_the_target(name, gains, baseline):
    flights = flytune.fly(classical_controller(name, baseline, gains), baseline, trials=20, seed=3)
    distance = np.linalg.norm(flights.position[:, -1] - flights.target_position, axis=-1)
    assert not flights.crashed.any() and distance.max() < 0.02
    turned = np.abs(np.asarray(heading(tuple(jnp.moveaxis(jnp.asarray(flights.attitude[:, -1]), -1, 0)))))
    assert turned.max() < math.radians(3.6)


@pytest.mark.parametrize(("name", "gains"), EVERY)
def test_the_same_gains_fly_a_vehicle_whose_motors_lag(name, gains):
    task = load_task("baseline", {"vehicle": "crazyflie-measured"})
    flights = flytune.fly(classical_controller(name, task, gains), task, trials=20, seed=3)
    distance = np.linalg.norm(flights.position[:, -1] - flights.target_position, axis=-1)
    assert not flights.crashed.any() and distance.max() < 0.1


@pytest.mark.parametrize("bound", [0.2, 0.8, 2.0])
@pytest.mark.parametrize("name", CLASSICAL)
def test_a_pilot_keeps_the_tasks_speed_bound_from_rest_and_level(name, bound, calm_flight):
    task = load_task("baseline", {"termination.speed.bound": bound})
    controller = classical_controller(name, task)
    initial_conditions = [[2, 2, 2], [-2, 1, 0.1], [0.3, -2, 1.5], [0, 0, 2]]
    speed = np.linalg.norm(calm_flight(controller, task, initial_conditions)["velocity"], axis=-1).max()
    assert speed < bound
    assert speed > 0.5 * min(bound, 1.2)  # and uses it, where the way is long enough


@pytest.mark.parametrize("name", CLASSICAL)
def test_without_a_speed_bound_a_pilot_flies_faster(name, calm_flight, baseline):
    table = plain(baseline)
    del table["termination"]["speed"]
    free = flytune.config.document.read(type(baseline), table)
    assert classical_controller(name, free).speed_limit is None
    states = calm_flight(classical_controller(name, free), free, [[2, 2, 2]])
    assert np.linalg.norm(states["velocity"], axis=-1).max() > 1.2
    np.testing.assert_allclose(states["position"][0, -1], [0, 0, 1], atol=0.02)


@pytest.mark.parametrize("name", CLASSICAL)
def test_a_world_turned_about_the_vertical_is_flown_the_same(name, baseline, calm_flight):
    turn = 2.1
    c, s = math.cos(turn), math.sin(turn)
    turned_task = load_task("baseline", {"target.yaw": turn})
    start, yaw = np.array([1.2, -0.7, 1.4]), 0.9
    turned_start = [c * start[0] - s * start[1], s * start[0] + c * start[1], start[2]]
    one = calm_flight(classical_controller(name, baseline), baseline, start, [0.1, -0.1, yaw], steps=400)
    other = calm_flight(
        classical_controller(name, turned_task), turned_task, turned_start, [0.1, -0.1, yaw + turn], steps=400
    )
    x, y, z = np.moveaxis(one["position"][0], -1, 0)
    # float32 rounding of 1e-7, amplified by attitude loops and integrated over 4 s
    np.testing.assert_allclose(other["position"][0], np.stack([c * x - s * y, s * x + c * y, z], -1), atol=1e-3)


@pytest.mark.parametrize("name", CLASSICAL)
def test_compiled_and_batched_a_pilot_answers_as_alone(name, baseline, observation):
    controller = classical_controller(name, baseline)
    rng = np.random.default_rng(0)
    seen = jnp.stack(
        [
            observation(baseline, position=tuple(rng.uniform(-1, 2, 3)), angles=rng.uniform(-0.3, 0.3, 3))
            for _ in range(4)
        ]
    )
    act = lambda one: controller.act(controller.initial_memory(), one)[1]  # noqa: E731
    alone = np.stack([act(one) for one in seen])
    # float32: other orders of summation, 1e-7 of squares that the action's range holds a few times
    np.testing.assert_allclose(jax.jit(act)(seen[0]), alone[0], atol=2e-5)
    np.testing.assert_allclose(jax.jit(jax.vmap(act))(seen), alone, atol=2e-5)


def test_other_gains_do_not_compile_another_program(baseline, observation):
    seen, count = observation(baseline), []

    @jax.jit
    def act(controller, one):
        count.append(1)
        return controller.act(controller.initial_memory(), one)[1]

    for name in CLASSICAL:
        for gains in SETS:
            act(classical_controller(name, baseline, gains), seen)
    assert len(count) == len(CLASSICAL)


# --- gains files and names ---


def test_an_unknown_pilot_is_refused_with_the_list(baseline):
    with pytest.raises(BadInput, match=r"^pdi: .*Allowed: geometric, lqr, pid\. Did you mean pid\?$"):
        classical_controller("pdi", baseline)


def test_an_unknown_set_of_gains_is_refused_with_the_list(baseline):
    with pytest.raises(BadInput, match=r"^gains: 'best' is not allowed. Allowed: tuned, textbook\.$"):
        classical_controller("pid", baseline, "best")


@pytest.mark.parametrize("name", CLASSICAL)
def test_gains_files_say_where_both_sets_come_from(name):
    file = resources.files("flytune.control") / "gains" / f"{name}.toml"
    sources = tomllib.loads(file.read_text(encoding="utf-8"))["sources"]
    assert {"textbook", "tuned"} <= {path.split(".")[0] for path in sources}
    assert "Optuna" in sources["tuned"] and "seed" in sources["tuned"]
    gains = read_gains(name)
    assert plain(gains["textbook"]) != plain(gains["tuned"])


@pytest.mark.parametrize(
    ("name", "path", "value", "complaint"),
    [
        ("pid", "tilt", -1.0, r"tilt: -1\.0 is not allowed\. Allowed: above 0 1/s\."),
        ("pid", "position_integral", float("nan"), r"position_integral: nan is not allowed\."),
        ("geometric", "bound_share", 1.2, r"bound_share: 1\.2 is not allowed\. Allowed: above 0 to 1"),
        ("geometric", "largest_yaw_error", 2.0, r"largest_yaw_error: 2\.0 is not allowed\."),
        ("lqr", "action", "much", r"action: 'much' is not allowed\. Allowed: above 0"),
        ("lqr", "tilts", 1.0, r"tilts: no such field\. Did you mean tilt "),
    ],
)
def test_a_bad_gain_is_refused_by_its_name(name, path, value, complaint):
    gains = read_gains(name)["tuned"]
    with pytest.raises(BadInput, match=complaint):
        read(type(gains), plain(gains) | {path: value})


def test_the_heading_is_the_yaw_angle():
    for yaw in (-3.0, -0.5, 0.0, 2.5):
        np.testing.assert_allclose(heading(from_euler(*map(jnp.float32, (0.2, -0.3, yaw)))), yaw, atol=1e-6)
