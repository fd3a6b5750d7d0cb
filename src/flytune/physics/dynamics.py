"""The equations of motion of one quadrotor and the step that integrates them (paper R1 to R6, R9)."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.physics import rotation
from flytune.physics.components import Components, add, cross, scale, unpack
from flytune.physics.rotors import commanded_rotor_speed, hover_action, thrust_and_torque
from flytune.physics.vehicle import TrueVehicle, Vehicle

CONTROL_PERIOD = 0.01  # s; the paper's (R6), and the longest physics step
PHYSICS_STEPS = 1  # per control period
RAD_PER_S = 2 * math.pi / 60  # of one rpm


@pytree
class State:
    """The state of one vehicle; vectors as tuples of scalars, see `components`."""

    position: Components  # 3, m, inertial frame, z up
    attitude: Components  # 4, unit quaternion (x, y, z, w), body to inertial
    velocity: Components  # 3, m/s, inertial frame
    body_rate: Components  # 3, rad/s, body frame
    rotor_speed_rpm: Components  # 4, rpm
    pending_actions: Float[Array, "latency 4"]  # actions on their way to the motors, oldest first


def hovering(vehicle: Vehicle, position: Components, attitude: Components = (0.0, 0.0, 0.0, 1.0)) -> State:
    """The vehicle at rest with its rotors at hover speed, or at that which its controller was told."""
    speed = vehicle.hover_rotor_speed_rpm
    if isinstance(vehicle, TrueVehicle):
        speed = commanded_rotor_speed(vehicle, hover_action(vehicle))
    return State(
        position=tuple(jnp.asarray(part, float) for part in position),
        attitude=tuple(jnp.asarray(part, float) for part in attitude),
        velocity=tuple(jnp.zeros(3)),
        body_rate=tuple(jnp.zeros(3)),
        rotor_speed_rpm=tuple(jnp.full(4, speed, float)),
        pending_actions=no_pending_actions(vehicle),
    )


def no_pending_actions(vehicle: Vehicle) -> Float[Array, "latency 4"]:
    """The actions on their way to the motors of a vehicle that has hovered so far."""
    return jnp.full((vehicle.action_latency_steps, 4), hover_action(vehicle), float)


def angular_momentum(vehicle: Vehicle, body_rate: Components) -> Components:
    """I w in kg m^2/s, body frame."""
    momentum = tuple(i * w for i, w in zip(vehicle.inertia, body_rate, strict=True))
    if vehicle.products_of_inertia is None:
        return momentum
    (xy, xz, yz), (x, y, z) = vehicle.products_of_inertia, body_rate
    return add(momentum, (xy * y + xz * z, xy * x + yz * z, xz * x + yz * y))


def angular_acceleration(vehicle: Vehicle, body_rate: Components, torque: Components) -> Components:
    """w' = I^-1 (tau - w x I w) in rad/s^2, body frame. Source: paper R3."""
    gyroscopic = cross(body_rate, angular_momentum(vehicle, body_rate))
    if vehicle.products_of_inertia is None:
        return tuple((t - g) / i for t, g, i in zip(torque, gyroscopic, vehicle.inertia, strict=True))
    (xx, yy, zz), (xy, xz, yz) = vehicle.inertia, vehicle.products_of_inertia
    # the inverse of a symmetric matrix by its cofactors, whose sum with a row is the determinant
    first = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy)
    second = (first[1], xx * zz - xz * xz, xy * xz - xx * yz)
    third = (first[2], second[2], xx * yy - xy * xy)
    determinant = xx * first[0] + xy * first[1] + xz * first[2]
    left = add(torque, scale(-1, gyroscopic))
    return tuple(sum(c * t for c, t in zip(row, left, strict=True)) / determinant for row in (first, second, third))


def body_drag(vehicle: Vehicle, attitude: Components, velocity: Components, rotor_speed_rpm: Components) -> Components:
    """The drag along the body's axes, seen in the inertial frame, in N.

        F_i = -(d_i + k_i sum of rotor speeds + c_i |v_i|) v_i  along each axis i of the body

    with the vehicle's `body_drag` d, `rotor_drag` k and `quadratic_drag` c.

    Args:
        vehicle: its coefficients.
        attitude: body to inertial.
        velocity: in m/s, inertial frame.
        rotor_speed_rpm: of each rotor.

    Source: Forster 2015 (rotors); Faessler, Franchi and Scaramuzza, IEEE RA-L 2018 (linear in the body frame).
    """
    along = rotation.rotate(rotation.conjugate(attitude), velocity)
    resistance = [vehicle.body_drag[axis] if vehicle.body_drag is not None else 0.0 for axis in range(3)]
    if vehicle.rotor_drag is not None:
        turning = RAD_PER_S * sum(rotor_speed_rpm[1:], start=rotor_speed_rpm[0])
        resistance = [r + k * turning for r, k in zip(resistance, vehicle.rotor_drag, strict=True)]
    if vehicle.quadratic_drag is not None:
        squares = zip(resistance, vehicle.quadratic_drag, along, strict=True)
        resistance = [r + c * jnp.abs(v) for r, c, v in squares]
    return rotation.rotate(attitude, tuple(-r * v for r, v in zip(resistance, along, strict=True)))


def has_body_drag(vehicle: Vehicle) -> bool:
    """Whether a vehicle has drag along its own axes."""
    return any(each is not None for each in (vehicle.body_drag, vehicle.rotor_drag, vehicle.quadratic_drag))


def rotor_speed_after(vehicle: Vehicle, now: Components, commanded: Components, elapsed: float) -> Components:
    """Rotor speeds in rpm after `elapsed` seconds of a constant command: the exact first-order response.

        rpm(t) = command + (rpm(0) - command) exp(-t / tau),  tau by whether the rotor speeds up or slows down

    A time constant of zero follows at once, also for elapsed = 0.

    Args:
        vehicle: its time constants.
        now: rotor speeds in rpm.
        commanded: likewise.
        elapsed: in s.
    """

    def share_left(time_constant: float | Float[Array, ""]) -> Float[Array, ""]:
        lags = jnp.asarray(time_constant) > 0
        return jnp.where(lags, jnp.exp(-elapsed / jnp.where(lags, time_constant, 1.0)), 0.0)

    rising = share_left(vehicle.motor_rise_time_constant)
    falling = share_left(vehicle.motor_fall_time_constant)
    return tuple(
        goal + (speed - goal) * jnp.where(goal > speed, rising, falling)
        for speed, goal in zip(now, commanded, strict=True)
    )


def step(vehicle: Vehicle, state: State, action: Float[Array, "4"], physics_steps: int = PHYSICS_STEPS) -> State:
    """The state one control period later, under one action in [-1, 1]^4.

    The motors receive the action after the latency.

    Args:
        vehicle: its numbers.
        state: the state now.
        action: of each motor.
        physics_steps: of the control period, and as many more as keep each of them at 0.01 s or less.

    Forces and attitude are also evaluated at the middle of a step. More steps are not more accurate in float32
    (docs/concepts/integrator.md).
    """
    physics_steps = max(physics_steps, math.ceil(vehicle.control_period / CONTROL_PERIOD - 1e-9))
    queue = jnp.concatenate([state.pending_actions, action[None]])
    commanded = tuple(commanded_rotor_speed(vehicle, motor) for motor in unpack(queue[0]))
    body = (state.position, state.attitude, state.velocity, state.body_rate)
    rotors, duration = state.rotor_speed_rpm, vehicle.control_period / physics_steps
    for _ in range(physics_steps):
        speeds = [rotor_speed_after(vehicle, rotors, commanded, t) for t in (0.0, duration / 2, duration)]
        body, rotors = _physics_step(vehicle, body, speeds, duration), speeds[-1]
    position, attitude, velocity, body_rate = body
    return State(
        position=position,
        attitude=attitude,
        velocity=velocity,
        body_rate=body_rate,
        rotor_speed_rpm=rotors,
        pending_actions=queue[1:],
    )


def _physics_step(
    vehicle: Vehicle, body: tuple[Components, ...], rotor_speeds: list[Components], h: float
) -> tuple[Components, ...]:
    """Position, attitude, velocity and body rate after h seconds, of fourth order.

    `rotor_speeds` holds the rotor speeds at the start, the middle and the end of the step. The equations form a chain,
    torque -> body rate -> attitude -> thrust direction -> velocity -> position, and each link is solved with what the
    link before it gives at these three instants: body rate by classical Runge-Kutta, attitude by the exponential of
    the fourth-order Magnus expansion (Iserles et al., Acta Numerica 2000, section 5; the sign is that of right
    multiplication), velocity and position by Simpson's rule and its once repeated form.
    """
    p, q, v, w = body
    forces = [thrust_and_torque(vehicle, speed) for speed in rotor_speeds]
    torques = [torque for _, torque in forces]

    def turn(rate: Components, instant: int) -> Components:
        return angular_acceleration(vehicle, rate, torques[instant])

    k1 = turn(w, 0)
    k2 = turn(add(w, scale(h / 2, k1)), 1)
    k3 = turn(add(w, scale(h / 2, k2)), 1)
    k4 = turn(add(w, scale(h, k3)), 2)
    w_end = add(w, scale(h / 6, add(k1, scale(2, k2), scale(2, k3), k4)))
    # the cubic through both ends and their slopes, at the middle
    w_middle = add(scale(0.5, add(w, w_end)), scale(h / 8, add(k1, scale(-1, turn(w_end, 2)))))

    whole = add(scale(h / 6, add(w, scale(4, w_middle), w_end)), scale(h**2 / 12, cross(w, w_end)))
    first_half = add(
        scale(h / 24, add(scale(5, w), scale(8, w_middle), scale(-1, w_end))), scale(h**2 / 48, cross(w, w_middle))
    )
    q_end = rotation.normalise(rotation.multiply(q, rotation.exponential(whole)))
    q_middle = rotation.multiply(q, rotation.exponential(first_half))

    weight = (0.0, 0.0, -vehicle.gravity)
    a0, a1, a2 = (
        add(scale(thrust / vehicle.mass, rotation.vertical_axis(attitude)), weight)
        for (thrust, _), attitude in zip(forces, (q, q_middle, q_end), strict=True)
    )
    if has_body_drag(vehicle):
        moved, v_end = _moved_against_drag(vehicle, v, (a0, a1, a2), (q, q_middle, q_end), rotor_speeds, h)
        return add(p, moved), q_end, v_end, w_end
    drag = tuple(coefficient / vehicle.mass for coefficient in vehicle.drag)
    undragged = add(scale(h, v), scale(h**2 / 6, add(a0, scale(2, a1))))
    slowed = add(scale(h**2 / 2, v), scale(h**3 / 6, add(a0, tuple(-d * c for d, c in zip(drag, v, strict=True)))))
    moved = tuple(u - d * s for u, d, s in zip(undragged, drag, slowed, strict=True))
    v_end = add(
        v,
        scale(h / 6, add(a0, scale(4, a1), a2)),
        tuple(-d * m for d, m in zip(drag, moved, strict=True)),  # drag is linear: its integral is -D times the way
    )
    return add(p, moved), q_end, v_end, w_end


def _moved_against_drag(
    vehicle: Vehicle,
    velocity: Components,
    accelerations: tuple[Components, Components, Components],
    attitudes: tuple[Components, Components, Components],
    rotor_speeds: list[Components],
    h: float,
) -> tuple[Components, Components]:
    """The way in m and the velocity in m/s after h seconds by classical Runge-Kutta, with every kind of drag.

    Args:
        vehicle: its drag.
        velocity: at the start.
        accelerations: from thrust and gravity, at the start, the middle and the end of the step.
        attitudes: likewise.
        rotor_speeds: likewise, in rpm.
        h: length of the step in s.
    """

    def acceleration(instant: int, v: Components) -> Components:
        inertial = tuple(-d * part for d, part in zip(vehicle.drag, v, strict=True))
        force = add(inertial, body_drag(vehicle, attitudes[instant], v, rotor_speeds[instant]))
        return add(accelerations[instant], scale(1 / vehicle.mass, force))

    k1 = acceleration(0, velocity)
    k2 = acceleration(1, add(velocity, scale(h / 2, k1)))
    k3 = acceleration(1, add(velocity, scale(h / 2, k2)))
    k4 = acceleration(2, add(velocity, scale(h, k3)))
    moved = add(scale(h, velocity), scale(h**2 / 6, add(k1, k2, k3)))
    return moved, add(velocity, scale(h / 6, add(k1, scale(2, k2), scale(2, k3), k4)))
