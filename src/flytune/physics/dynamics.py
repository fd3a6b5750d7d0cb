"""The equations of motion of one quadrotor and the step that integrates them (paper R1 to R6, R9)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.physics import rotation
from flytune.physics.vehicle import Vehicle
from flytune.pytree import pytree

CONTROL_PERIOD = 0.01  # s (paper R6)
PHYSICS_STEPS = 2  # per control period: 200 Hz (reading of R6; docs/integrator.md shows that finer buys nothing)


@pytree
class State:
    """Everything that moves, of one vehicle."""

    position: Float[Array, "3"]  # m, inertial frame, z up
    attitude: Float[Array, "4"]  # unit quaternion (x, y, z, w), body to inertial
    velocity: Float[Array, "3"]  # m/s, inertial frame
    body_rate: Float[Array, "3"]  # rad/s, body frame
    rotor_speed_rpm: Float[Array, "4"]  # rpm
    pending_actions: Float[Array, "latency 4"]  # actions on their way to the motors, oldest first


def hovering(vehicle: Vehicle, position: Float[Array, "3"], attitude: Float[Array, "4"]) -> State:
    """The vehicle at rest with its rotors at hover speed."""
    return State(
        position=position,
        attitude=attitude,
        velocity=jnp.zeros(3),
        body_rate=jnp.zeros(3),
        rotor_speed_rpm=jnp.full(4, vehicle.hover_rotor_speed_rpm),
        pending_actions=jnp.zeros((vehicle.action_latency_steps, 4)),
    )


def commanded_rotor_speed(vehicle: Vehicle, action: Float[Array, "4"]) -> Float[Array, "4"]:
    """The rotor speed in rpm an action asks for: hover speed * (1 + action_scale * action), within the motors' limit.

    The action is clipped to [-1, 1].

    Source: paper R9, where action_scale is 1/2.
    """
    wanted = vehicle.hover_rotor_speed_rpm * (1 + vehicle.action_scale * jnp.clip(action, -1.0, 1.0))
    return jnp.minimum(wanted, vehicle.maximum_rotor_speed_rpm)


def thrust_and_torque(
    vehicle: Vehicle, rotor_speed_rpm: Float[Array, "4"]
) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Thrust along the body's z axis in N, and torque in the body frame in N m.

        f_i = kf rpm_i^2
        tau_x = l (-f0 - f1 + f2 + f3)
        tau_y = l (-f0 + f1 + f2 - f3)
        tau_z = km (-rpm0^2 + rpm1^2 - rpm2^2 + rpm3^2)

    Source: paper R4.
    """
    s0, s1, s2, s3 = rotor_speed_rpm**2
    bending = vehicle.thrust_coefficient * vehicle.lever
    torque = jnp.stack(
        [
            bending * (-s0 - s1 + s2 + s3),
            bending * (-s0 + s1 + s2 - s3),
            vehicle.torque_coefficient * (-s0 + s1 - s2 + s3),
        ]
    )
    return vehicle.thrust_coefficient * (s0 + s1 + s2 + s3), torque


def derivative(vehicle: Vehicle, state: State, rotor_speed_rpm: Float[Array, "4"]) -> State:
    """The time derivative of the rigid body, for given rotor speeds in rpm; its rotor and action fields are zero.

        p'' = R(q) [0, 0, T] / m - [0, 0, g] - D p' / m
        q'  = 1/2 q (x) [w, 0]
        w'  = I^-1 (tau - w x I w)

    Source: paper R1, R2, R3.
    """
    thrust, torque = thrust_and_torque(vehicle, rotor_speed_rpm)
    inertia = jnp.stack(vehicle.inertia)
    drag = jnp.stack(vehicle.drag) * state.velocity
    weight = jnp.array([0.0, 0.0, 1.0]) * vehicle.gravity
    spin = jnp.append(state.body_rate, 0.0)
    return State(
        position=state.velocity,
        attitude=0.5 * rotation.multiply(state.attitude, spin),
        velocity=(thrust * rotation.vertical_axis(state.attitude) - drag) / vehicle.mass - weight,
        body_rate=(torque - jnp.cross(state.body_rate, inertia * state.body_rate)) / inertia,
        rotor_speed_rpm=jnp.zeros_like(state.rotor_speed_rpm),
        pending_actions=jnp.zeros_like(state.pending_actions),
    )


def rotor_speed_after(
    vehicle: Vehicle, now: Float[Array, "4"], commanded: Float[Array, "4"], elapsed: float
) -> Float[Array, "4"]:
    """Rotor speeds in rpm after `elapsed` seconds of a constant command: the exact first-order response.

        rpm(t) = command + (rpm(0) - command) exp(-t / tau),  tau by whether the rotor speeds up or slows down

    A time constant of zero follows at once, also for elapsed = 0.
    """

    def share_left(time_constant: float | Float[Array, ""]) -> Float[Array, ""]:
        lags = jnp.asarray(time_constant) > 0
        return jnp.where(lags, jnp.exp(-elapsed / jnp.where(lags, time_constant, 1.0)), 0.0)

    rising = share_left(vehicle.motor_rise_time_constant)
    falling = share_left(vehicle.motor_fall_time_constant)
    return commanded + (now - commanded) * jnp.where(commanded > now, rising, falling)


def step(vehicle: Vehicle, state: State, action: Float[Array, "4"], physics_steps: int = PHYSICS_STEPS) -> State:
    """The state one control period (0.01 s) later, under one action in [-1, 1]^4.

    The action waits out the latency, moves the motors, and the motors move the body: classical Runge-Kutta of fourth
    order on the rigid body, the rotor speeds inserted in closed form, the quaternion normalised after every step.
    """
    queue = jnp.concatenate([state.pending_actions, action[None]])
    commanded = commanded_rotor_speed(vehicle, queue[0])
    state = State(**{**vars(state), "pending_actions": queue[1:]})
    duration = CONTROL_PERIOD / physics_steps

    def physics_step(state: State, _: None) -> tuple[State, None]:
        return _runge_kutta(vehicle, state, commanded, duration), None

    return jax.lax.scan(physics_step, state, length=physics_steps, unroll=1)[0]


def _runge_kutta(vehicle: Vehicle, state: State, commanded: Float[Array, "4"], duration: float) -> State:
    half = duration / 2
    speeds = [rotor_speed_after(vehicle, state.rotor_speed_rpm, commanded, t) for t in (0.0, half, duration)]

    def ahead(slope: State, time: float) -> State:
        return jax.tree.map(lambda value, rate: value + time * rate, state, slope)

    k1 = derivative(vehicle, state, speeds[0])
    k2 = derivative(vehicle, ahead(k1, half), speeds[1])
    k3 = derivative(vehicle, ahead(k2, half), speeds[1])
    k4 = derivative(vehicle, ahead(k3, duration), speeds[2])
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    end = ahead(mean, duration)
    return State(
        position=end.position,
        attitude=rotation.normalise(end.attitude),
        velocity=end.velocity,
        body_rate=end.body_rate,
        rotor_speed_rpm=speeds[2],
        pending_actions=state.pending_actions,
    )
