"""Accuracy and cost of the physics step: prints the tables of docs/concepts/integrator.md as Markdown.

    python benchmarks/integrator.py

A hard manoeuvre of 2 s is flown with several integrators and compared with DOP853 in float64, at a tolerance of 1e-11,
on equations written out once more in NumPy; then the same integrators are timed, forward and with their gradient.
"""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import math
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from flytune.physics import dynamics, rotation
from flytune.physics.components import Components, add, scale, unpack
from flytune.physics.dynamics import CONTROL_PERIOD, State
from flytune.physics.rotors import commanded_rotor_speed, thrust_and_torque
from flytune.physics.vehicle import Vehicle, load_vehicle

STEPS = 200  # control periods, 2 s
VEHICLES = {"crazyflie": (2.2, 0.55, 0.45, 0.1), "crazyflie-measured": (1.0, 0.6, 0.5, 0.2)}  # the manoeuvre of each
ROLL, PITCH, YAW = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]])


def manoeuvre(frequency: float, roll: float, pitch: float, lift: float) -> np.ndarray:
    """Actions [T, 4] that swing roll and pitch, not in step, to both sides alike, from level and still."""
    phase = 2 * math.pi * frequency * CONTROL_PERIOD * np.arange(STEPS)[:, None]

    def swing(phase: np.ndarray) -> np.ndarray:
        return 0.75 * np.sin(3 * phase) - 0.25 * np.sin(phase)

    return lift + roll * ROLL * swing(phase) + pitch * PITCH * swing(0.8 * phase) + 0.1 * YAW * swing(0.5 * phase)


def reference(vehicle: Vehicle, actions: np.ndarray) -> np.ndarray:
    """States [T + 1, 13] (p, q, v, w) from a hover at 1 m: DOP853, one integration per control period."""
    d, mass, kf, km = vehicle.arm / math.sqrt(2), vehicle.mass, vehicle.thrust_coefficient, vehicle.torque_coefficient
    inertia, drag = np.array(vehicle.inertia), np.array(vehicle.drag)
    hover = math.sqrt(vehicle.gravity * mass / 4 / kf)
    wanted = np.minimum(hover * (1 + vehicle.action_scale * np.clip(actions, -1, 1)), vehicle.maximum_rotor_speed_rpm)

    def rotors(t: float, now: np.ndarray, goal: np.ndarray) -> np.ndarray:
        constant = np.where(goal > now, vehicle.motor_rise_time_constant, vehicle.motor_fall_time_constant)
        return goal + (now - goal) * (np.exp(-t / constant) if np.all(constant > 0) else 0.0)

    def rates(t: float, y: np.ndarray, now: np.ndarray, goal: np.ndarray) -> np.ndarray:
        x, y_, z, s = y[3:7]
        v, w = y[7:10], y[10:]
        f = rotors(t, now, goal) ** 2
        torque = np.array([kf * d * (f @ ROLL), kf * d * (f @ PITCH), km * (f @ YAW)])
        up = np.array([2 * (x * z + s * y_), 2 * (y_ * z - s * x), s * s - x * x - y_ * y_ + z * z])
        turn = 0.5 * np.array([*(s * w + np.cross([x, y_, z], w)), -np.dot([x, y_, z], w)])
        pull = kf * f.sum() * up / mass - [0, 0, vehicle.gravity] - drag * v / mass
        return np.concatenate([v, turn, pull, (torque - np.cross(w, inertia * w)) / inertia])

    states, now = [np.array([0, 0, 1, 0, 0, 0, 1, *np.zeros(6)])], np.full(4, hover)
    for goal in wanted:
        span = (0, CONTROL_PERIOD)
        flown = solve_ivp(rates, span, states[-1], "DOP853", args=(now, goal), rtol=1e-11, atol=1e-11)
        states, now = [*states, flown.y[:, -1]], rotors(CONTROL_PERIOD, now, goal)
    return np.array(states)


def classical(vehicle: Vehicle, state: State, action: jax.Array, physics_steps: int, arrays: bool = False) -> State:
    """One control period by classical Runge-Kutta on the whole state, for comparison; vectors as scalars or arrays."""
    body, now = (state.position, state.attitude, state.velocity, state.body_rate), state.rotor_speed_rpm
    h = CONTROL_PERIOD / physics_steps
    queue = jnp.concatenate([state.pending_actions, action[None]])
    goal = tuple(commanded_rotor_speed(vehicle, motor) for motor in unpack(queue[0]))
    rates = rates_of_arrays if arrays else rates_of_scalars
    if arrays:
        body, now, goal = jax.tree.map(jnp.stack, (body, now, goal), is_leaf=lambda x: isinstance(x[0], jax.Array))
    for _ in range(physics_steps):
        if arrays:
            speeds = [jnp.stack(dynamics.rotor_speed_after(vehicle, now, goal, t)) for t in (0.0, h / 2, h)]
        else:
            speeds = [dynamics.rotor_speed_after(vehicle, now, goal, t) for t in (0.0, h / 2, h)]
        move = lambda k, t: jax.tree.map(lambda y, rate: y + t * rate, body, k)  # noqa: B023, E731
        k1 = rates(vehicle, body, speeds[0])
        k2 = rates(vehicle, move(k1, h / 2), speeds[1])
        k3 = rates(vehicle, move(k2, h / 2), speeds[1])
        k4 = rates(vehicle, move(k3, h), speeds[2])
        body = jax.tree.map(lambda y, a, b, c, d: y + h / 6 * (a + 2 * b + 2 * c + d), body, k1, k2, k3, k4)
        p, q, v, w = body
        body, now = (p, q / jnp.linalg.norm(q) if arrays else rotation.normalise(q), v, w), speeds[2]
    if arrays:
        (p, q, v, w), now = jax.tree.map(tuple, (body, now))
    else:
        p, q, v, w = body
    return State(position=p, attitude=q, velocity=v, body_rate=w, rotor_speed_rpm=now, pending_actions=queue[1:])


def rates_of_scalars(vehicle: Vehicle, body: tuple[Components, ...], rotors: Components) -> tuple[Components, ...]:
    """The derivatives of position, attitude, velocity and body rate, on tuples of scalars."""
    _, q, v, w = body
    thrust, torque = thrust_and_torque(vehicle, rotors)
    drag = tuple(-d / vehicle.mass * s for d, s in zip(vehicle.drag, v, strict=True))
    pull = add(scale(thrust / vehicle.mass, rotation.vertical_axis(q)), drag, (0.0, 0.0, -vehicle.gravity))
    return v, scale(0.5, rotation.multiply(q, (*w, 0.0))), pull, dynamics.angular_acceleration(vehicle, w, torque)


def rates_of_arrays(vehicle: Vehicle, body: tuple[jax.Array, ...], rotors: jax.Array) -> tuple[jax.Array, ...]:
    """The same on arrays of 3, 4, 3 and 3."""
    _, q, v, w = body
    x, y, z, s = q
    squares = vehicle.thrust_coefficient * rotors**2
    lever, ratio = vehicle.lever, vehicle.torque_coefficient / vehicle.thrust_coefficient
    torque = jnp.stack([lever * (squares @ ROLL), lever * (squares @ PITCH), ratio * (squares @ YAW)])
    up = jnp.stack([2 * (x * z + s * y), 2 * (y * z - s * x), 1 - 2 * (x * x + y * y)])
    pull = (squares.sum() * up - jnp.stack(vehicle.drag) * v) / vehicle.mass - vehicle.gravity * jnp.array([0, 0, 1.0])
    turn = 0.5 * jnp.append(s * w + jnp.cross(q[:3], w), -(q[:3] @ w))
    inertia = jnp.stack(vehicle.inertia)
    return v, turn, pull, (torque - jnp.cross(w, inertia * w)) / inertia


METHODS = {
    **{f"flytune, {n}": partial(dynamics.step, physics_steps=n) for n in (1, 2, 4, 8)},
    **{f"Runge-Kutta, {n}": partial(classical, physics_steps=n) for n in (1, 2, 4)},
}


def errors(method: partial, vehicle: Vehicle, actions: np.ndarray, exact: np.ndarray, double: bool) -> list[float]:
    """Largest error over the 2 s: position in m, attitude in rad, velocity in m/s, body rate in rad/s."""
    with jax.enable_x64(double):

        @jax.jit
        def fly(vehicle: Vehicle, actions: jax.Array) -> tuple[Components, ...]:
            def advance(state: State, action: jax.Array) -> tuple[State, tuple[Components, ...]]:
                state = method(vehicle, state, action)
                return state, (state.position, state.attitude, state.velocity, state.body_rate)

            return jax.lax.scan(advance, dynamics.hovering(vehicle, (0.0, 0.0, 1.0)), actions)[1]

        flown = fly(vehicle, jnp.asarray(actions, float))
    p, q, v, w = (np.stack(part, axis=-1).astype(float) for part in flown)
    goal = exact[1:]
    dot = np.abs(np.sum(q * goal[:, 3:7], axis=-1)) / np.linalg.norm(q, axis=-1)
    apart = np.linalg.norm(q - goal[:, 3:7] * np.sign(np.sum(q * goal[:, 3:7], axis=-1))[:, None], axis=-1)
    angle = np.where(apart < 1e-3, 2 * apart, 2 * np.arccos(np.minimum(dot, 1)))
    parts = [np.linalg.norm(a - b, axis=-1) for a, b in ((p, goal[:, :3]), (v, goal[:, 7:10]), (w, goal[:, 10:]))]
    return [parts[0].max(), angle.max(), parts[1].max(), parts[2].max()]


def times(method: partial, vehicle: Vehicle, vehicles: int = 64, steps: int = 250) -> tuple[float, float]:
    """Seconds for a flight forward and for its gradient in the actions, each the best of 20."""

    def loss(actions: jax.Array) -> jax.Array:
        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = method(vehicle, state, action)
            return state, sum(part**2 for part in state.position)

        one = lambda a: jax.lax.scan(advance, dynamics.hovering(vehicle, (0.0, 0.0, 1.0)), a)[1].sum()  # noqa: E731
        return jax.vmap(one, in_axes=1)(actions).sum()

    actions = jax.random.uniform(jax.random.key(0), (steps, vehicles, 4), minval=-0.3, maxval=0.3)
    best = []
    for function in (jax.jit(loss), jax.jit(jax.grad(loss))):
        jax.block_until_ready(function(actions))
        tries = []
        for _ in range(20):
            start = time.perf_counter()
            jax.block_until_ready(function(actions))
            tries.append(time.perf_counter() - start)
        best.append(min(tries))
    return best[0], best[1]


def main() -> None:
    """Print both tables."""
    for name, shape in VEHICLES.items():
        vehicle, actions = load_vehicle(name), manoeuvre(*shape)
        exact = reference(vehicle, actions)
        speed, peak = np.linalg.norm(exact[:, 7:10], axis=1).max(), np.linalg.norm(exact[:, 10:], axis=1).max()
        print(f"\n`{name}`: peak {math.degrees(peak):.0f} deg/s, {speed:.1f} m/s\n")
        print("| method, steps per 10 ms | precision | position [m] | attitude [rad] | velocity [m/s] | rate [rad/s] |")
        print("|---|---|---|---|---|---|")
        for double in (True, False):
            for label, method in METHODS.items():
                numbers = " | ".join(f"{e:.1e}" for e in errors(method, vehicle, actions, exact, double))
                print(f"| {label} | {'float64' if double else 'float32'} | {numbers} |")
    candidates = {label: method for label, method in METHODS.items() if not label.endswith("8")}
    candidates["Runge-Kutta on arrays, 1"] = partial(classical, physics_steps=1, arrays=True)
    print("\n| method, steps per 10 ms | forward [ms] | ratio | with gradient [ms] | ratio |\n|---|---|---|---|---|")
    first = times(candidates["flytune, 1"], load_vehicle("crazyflie"))
    for label, method in candidates.items():
        forward, gradient = first if label == "flytune, 1" else times(method, load_vehicle("crazyflie"))
        print(f"| {label} | {forward * 1e3:.2f} | {forward / first[0]:.2f} | ", end="")
        print(f"{gradient * 1e3:.2f} | {gradient / first[1]:.2f} |", flush=True)


if __name__ == "__main__":
    main()
