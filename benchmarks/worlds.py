"""How other simulators differ from flytune's, and why: prints the tables of docs/results/worlds.md as Markdown.

    python benchmarks/worlds.py [POLICY.safetensors]

First the same actions in every world, against equations integrated in float64 with a tiny step, one cause at a time;
then the same policy in every world, from the same starts and with the same noise (left out without a policy).
"""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from integrator import METHODS, errors, manoeuvre
from integrator import reference as dop853

from flytune.config.pytree import pytree
from flytune.control.policy import load_policy
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import Judgement, judge
from flytune.evaluation.statistics import bootstrap_interval, median
from flytune.physics import rotation
from flytune.physics.components import pack, unpack
from flytune.physics.dynamics import CONTROL_PERIOD
from flytune.physics.rotors import places, spins
from flytune.physics.vehicle import Vehicle, load_vehicle
from flytune.simulation.actuator import Actuator
from flytune.simulation.aerodynamics import ground_effect
from flytune.simulation.simulator import VehicleStates, to_inertial
from flytune.simulation.simulators import make_simulator
from flytune.task.files import load_task

MANOEUVRES = {"moderate": (1.0, 0.05, 0.04, 0.06), "hard": (2.2, 0.37, 0.3, 0.1)}  # see integrator.manoeuvre
LAGGING = (1.0, 0.3, 0.25, 0.15)  # for the vehicle whose motors lag
FINE = 10  # Runge-Kutta steps per control period, of the equations

Trajectory = np.ndarray  # [T + 1, 13]: position, attitude, velocity, body rate


def equations(
    vehicle: Vehicle,
    actions: np.ndarray,
    *,
    gyroscopic: bool = True,
    damping: float = 0.0,
    near_ground: bool = False,
    rotors_drag: bool = False,
) -> Trajectory:
    """The equations of motion from a hover at 1 m, by classical Runge-Kutta in float64, with what a world adds."""
    inertia, drag, mass = np.array(vehicle.inertia), np.array(vehicle.drag), vehicle.mass

    def rates(y: np.ndarray, rpm: np.ndarray) -> np.ndarray:
        q, v, w = y[3:7], y[7:10], y[10:]
        thrust = vehicle.thrust_coefficient * rpm**2
        if near_ground:
            thrust = thrust * (1 + ground_effect(vehicle, y[None, :3], q[None])[0])
        torque = np.array(
            [
                thrust @ places(vehicle)[:, 1],
                -thrust @ places(vehicle)[:, 0],
                vehicle.torque_coefficient * rpm**2 @ np.array(spins(vehicle)),
            ]
        )
        pull = to_inertial(q[None], np.array([[0, 0, thrust.sum()]]))[0] - drag * v
        if rotors_drag:
            slowed = dataclasses.replace(vehicle, rotor_drag=vehicle.optional_rotor_drag)
            pull = pull + to_inertial(q[None], drag(slowed, q[None], v[None], rpm[None]))[0]
        twist = np.cross(w, inertia * w) if gyroscopic else 0.0
        turn = 0.5 * np.array([*(q[3] * w + np.cross(q[:3], w)), -q[:3] @ w])
        gravity = np.array([0, 0, vehicle.gravity])
        slowing = [damping * (1 + np.linalg.norm(rate)) * rate for rate in (v, w)]
        return np.concatenate([v, turn, pull / mass - gravity - slowing[0], (torque - twist) / inertia - slowing[1]])

    actuator, h = Actuator(vehicle, 1), CONTROL_PERIOD / FINE
    y = np.array([0, 0, 1, 0, 0, 0, 1, *np.zeros(6)])
    flown = [y]
    for action in actions:
        actuator.command(action[None])
        for _ in range(FINE):
            first, middle = actuator.turn(0.0)[0], actuator.turn(h)[0]
            k1 = rates(y, first)
            k2 = rates(y + h / 2 * k1, middle)
            k3 = rates(y + h / 2 * k2, middle)
            k4 = rates(y + h * k3, actuator.rotor_speed_rpm[0])
            y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            y[3:7] /= np.linalg.norm(y[3:7])
        flown.append(y)
    return np.array(flown)


def fly_open_loop(vehicle: Vehicle, actions: np.ndarray, name: str, options: dict[str, Any]) -> Trajectory:
    """The same actions from the same hover, in a world."""
    simulator = make_simulator(name, vehicle, 1, options)
    hover = np.full((1, 4), vehicle.hover_rotor_speed_rpm)
    level, still = np.array([[0, 0, 0, 1.0]]), np.zeros((1, 3))
    start = np.array([[0, 0, 1.0]])
    simulator.place(
        VehicleStates(position=start, attitude=level, velocity=still, body_rate=still, rotor_speed_rpm=hover)
    )
    flown = []
    for action in [None, *actions]:
        if action is not None:
            simulator.advance(action[None])
        body = simulator.states()
        flown.append(np.concatenate([body.position[0], body.attitude[0], body.velocity[0], body.body_rate[0]]))
    simulator.close()
    return np.array(flown)


def apart(one: Trajectory, other: Trajectory) -> list[float]:
    """Largest difference over the flight: position in m, attitude in rad, body rate in rad/s."""
    sign = np.sign(np.sum(one[:, 3:7] * other[:, 3:7], axis=1, keepdims=True))
    chord = np.linalg.norm(one[:, 3:7] - sign * other[:, 3:7], axis=1)
    position, rate = (np.linalg.norm((one - other)[:, part], axis=1).max() for part in (slice(0, 3), slice(10, 13)))
    return [position, 4 * math.asin(min(chord.max() / 2, 1.0)), rate]


def row(label: str, *differences: list[float]) -> None:
    """Print one row of a table."""
    cells = [f"{number:.1e}" for difference in differences for number in difference]
    print(f"| {label} | " + " | ".join(cells) + " |", flush=True)


def heading(*columns: str) -> None:
    """Print the head of a table."""
    print(f"\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")


def compare_integrators(vehicle: Vehicle, actions: np.ndarray) -> None:
    """Each world against the equations, and against flytune."""
    exact, own = equations(vehicle, actions), fly_open_loop(vehicle, actions, "flytune", {})
    heading("world", "position [m]", "attitude [rad]", "rate [rad/s]", "position, from flytune [m]")
    row("equations, solved by DOP853", apart(dop853(vehicle, actions), exact), apart(dop853(vehicle, actions), own)[:1])
    row("flytune", apart(own, exact), [0.0])
    position, attitude, _, rate = errors(METHODS["flytune, 1"], vehicle, actions, exact, double=True)
    row("flytune, in float64", [position, attitude, rate])
    for label, name, options in (
        ("MuJoCo, RK4, 200 Hz", "mujoco", {}),
        ("MuJoCo, Euler, 200 Hz", "mujoco", {"integrator": "Euler"}),
        ("PyBullet, 200 Hz", "pybullet", {}),
        ("PyBullet, 1,000 Hz", "pybullet", {"physics_steps": 10}),
        ("PyBullet, 4,000 Hz", "pybullet", {"physics_steps": 40}),
    ):
        flown = fly_open_loop(vehicle, actions, name, options)
        row(label, apart(flown, exact), apart(flown, own)[:1])
    euler = fly_open_loop(vehicle, actions, "mujoco", {"integrator": "Euler"})
    bullet = fly_open_loop(vehicle, actions, "pybullet", {})
    print(f"\nPyBullet from MuJoCo's Euler, both at 200 Hz: {apart(bullet, euler)[0]:.1e} m", end="")
    print(", {:.1e} rad, {:.1e} rad/s".format(*apart(bullet, euler)[1:]))


def compare_causes(vehicle: Vehicle, actions: np.ndarray) -> None:
    """What each cause does to the equations, and whether PyBullet with it does the same."""
    exact = equations(vehicle, actions)
    heading(
        "cause",
        *("position [m]", "attitude [rad]", "rate [rad/s]"),
        *("left at 200 Hz: position [m]", "attitude [rad]", "rate [rad/s]"),
        *("left at 4,000 Hz: position [m]", "attitude [rad]", "rate [rad/s]"),
    )
    for label, causes, options in (
        ("none", {}, {}),
        ("damping 0.04", {"damping": 0.04}, {"damping": 0.04}),
        ("ground effect", {"near_ground": True}, {"ground_effect": True}),
        ("rotor drag", {"rotors_drag": True}, {"rotor_drag": True}),
    ):
        moved = equations(vehicle, actions, **causes)
        left = [
            apart(fly_open_loop(vehicle, actions, "pybullet", options | {"physics_steps": steps}), moved)
            for steps in (2, 40)
        ]
        row(label, apart(moved, exact), *left)
    row("no gyroscopic torque", apart(equations(vehicle, actions, gyroscopic=False), exact))
    mistaken = exact.copy()
    mistaken[:, 10:] = to_inertial(exact[:, 3:7], exact[:, 10:])
    row("body rate left in the inertial frame", apart(mistaken, exact))


@pytree
class RateInInertialFrame:
    """A controller that gets the angular velocity in the inertial frame instead of the body rate (target yaw 0)."""

    controller: Any

    def initial_memory(self) -> Any:
        """The controller's own."""
        return self.controller.initial_memory()

    def act(self, memory: Any, observation: Any) -> tuple[Any, Any]:
        """The controller's answer to the wrong numbers."""
        numbers = unpack(observation)
        attitude, rate = numbers[3:7], numbers[10:13]
        turned = rotation.multiply(rotation.multiply(attitude, (*rate, jnp.zeros(()))), rotation.conjugate(attitude))
        return self.controller.act(memory, pack((*numbers[:10], *turned[:3], *numbers[13:])))


def compare_responses(file: Path) -> None:
    """The same policy, starts and noise in every world."""
    policy, task = load_policy(file), load_task("baseline")
    everything = {"damping": 0.04, "ground_effect": True, "rotor_drag": True}
    wrong = RateInInertialFrame(controller=policy)
    flights: list[tuple[str, Any, str, dict[str, Any]]] = [
        ("flytune", policy, "flytune", {}),
        ("MuJoCo, RK4", policy, "mujoco", {}),
        ("MuJoCo, Euler", policy, "mujoco", {"integrator": "Euler"}),
        ("PyBullet", policy, "pybullet", {}),
        ("PyBullet, 1,000 Hz", policy, "pybullet", {"physics_steps": 10}),
        ("PyBullet, damping 0.04", policy, "pybullet", {"damping": 0.04}),
        ("PyBullet, ground effect", policy, "pybullet", {"ground_effect": True}),
        ("PyBullet, rotor drag", policy, "pybullet", {"rotor_drag": True}),
        ("PyBullet, all three", policy, "pybullet", everything),
        ("flytune, rate in the wrong frame", wrong, "flytune", {}),
        ("PyBullet, rate in the wrong frame", wrong, "pybullet", {}),
    ]
    heading(
        "world",
        "settled x, y, z, yaw",
        "settling x, y, z, yaw [s]",
        "error [mm]",
        "peak speed [m/s]",
        "speed bound crossed",
        "later than flytune: position [s] (95 %)",
        "z [s] (95 %)",
    )
    first = None
    for label, controller, name, options in flights:
        result = judge(fly(controller, task, simulator=name, simulator_options=options))
        first = first or result
        settled = ", ".join(str(result.settled(axis)) for axis in ("x", "y", "z", "yaw"))
        times = ", ".join(_number(median(result.settling_time[axis]), ".2f") for axis in ("x", "y", "z", "yaw"))
        error = _number(median(result.steady_state_error["position"] * 1e3), ".1f")
        later = [_later(result, first, channel) for channel in ("position", "z")]
        print(f"| {label} | {settled} | {times} | {error} | {_number(median(result.peak_speed), '.3f')}", end="")
        print(f" | {int(result.violated['speed'].sum())} | {' | '.join(later)} |", flush=True)


def _later(result: Judgement, first: Judgement, channel: str) -> str:
    """Mean of how much later the trials settled that settled in both worlds, and its interval."""
    both = np.isfinite(result.settling_time[channel]) & np.isfinite(first.settling_time[channel])
    late = (result.settling_time[channel] - first.settling_time[channel])[both]
    if result is first or late.size == 0:
        return ""
    low, high = bootstrap_interval([late], _mean)
    return f"{_mean(late):+.3f} ({_number(low, '+.3f')} to {_number(high, '+.3f')})"


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values))


def _number(value: float | None, form: str) -> str:
    return "none" if value is None else format(value, form)


def main() -> None:
    """Print the tables."""
    vehicle = load_vehicle("crazyflie")
    for name, shape in MANOEUVRES.items():
        actions = manoeuvre(*shape)
        exact = equations(vehicle, actions)
        speed, peak = np.linalg.norm(exact[:, 7:10], axis=1).max(), np.linalg.norm(exact[:, 10:], axis=1).max()
        print(f"\n## {name}: peak {math.degrees(peak):.0f} deg/s, {speed:.1f} m/s, lowest {exact[:, 2].min():.2f} m")
        compare_integrators(vehicle, actions)
        compare_causes(vehicle, actions)
    print("\n## crazyflie-measured: drag and motor lag")
    compare_integrators(load_vehicle("crazyflie-measured"), manoeuvre(*LAGGING))
    if len(sys.argv) > 1:
        print("\n## responses")
        compare_responses(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
