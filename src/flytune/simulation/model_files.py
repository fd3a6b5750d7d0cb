"""A vehicle as URDF and MJCF, the files of other simulators, with all digits of every number."""

import math
from collections.abc import Iterable
from typing import Literal

from flytune.physics.dynamics import CONTROL_PERIOD, has_body_drag
from flytune.physics.rotors import places, reach, spins, thrust
from flytune.physics.vehicle import Vehicle, inertia_matrix

Integrator = Literal["RK4", "Euler", "implicit", "implicitfast"]

THICKNESS = 2e-3  # m, of the shapes that are drawn; they have neither mass nor contact


def urdf(vehicle: Vehicle) -> str:
    """The vehicle as URDF: one link with mass and inertia, drawn with a disc at each motor.

    It has no collision shapes, and URDF has neither rotors nor drag: the caller applies the forces. The tag
    `properties` tells the rotors as gym-pybullet-drones has them, and their spins.
    """
    (ixx, ixy, ixz), (_, iyy, iyz), (_, _, izz) = inertia_matrix(vehicle).tolist()
    side = reach(vehicle) / math.sqrt(2)
    discs = "".join(
        f"""
    <visual name="prop{motor}">
      <origin xyz="{place}" rpy="0 0 0"/>
      <geometry>
        <cylinder radius="{float(vehicle.propeller_radius)!r}" length="{THICKNESS}"/>
      </geometry>
    </visual>"""
        for motor, place in enumerate(_motor_places(vehicle))
    )
    return f"""<?xml version="1.0"?>
<robot name="{_name(vehicle)}">
  <properties {_properties(vehicle)}/>
  <link name="body">
    <inertial>
      <origin xyz="0 0 0" rpy="0 0 0"/>
      <mass value="{float(vehicle.mass)!r}"/>
      <inertia ixx="{ixx!r}" iyy="{iyy!r}" izz="{izz!r}" ixy="{ixy!r}" ixz="{ixz!r}" iyz="{iyz!r}"/>
    </inertial>
    <visual>
      <geometry>
        <box size="{side!r} {side!r} {THICKNESS}"/>
      </geometry>
    </visual>{discs}
  </link>
</robot>
"""


def mjcf(vehicle: Vehicle, *, timestep: float = CONTROL_PERIOD / 2, integrator: Integrator = "RK4") -> str:
    """The vehicle as MJCF: a free body, a site at each motor, and an actuator on it whose control is thrust in N.

    A motor's torque about z is km / kf times its thrust. Where the curves have linear parts, the actuator `yaw` takes
    what its torque differs from that, in N m; where the vehicle has drag along its own axes, `drag_x`, `drag_y` and
    `drag_z` take it in N. The caller simulates rotor lag and latency, and sets the drag along the inertial axes, for
    which a free joint has one coefficient and a vehicle three.
    """
    ratio = torque_ratio(vehicle)
    strongest = float(thrust(vehicle, vehicle.top_rotor_speed_rpm))
    inertia = f'diaginertia="{_numbers(vehicle.inertia)}"'
    if vehicle.products_of_inertia is not None:
        inertia = f'fullinertia="{_numbers((*vehicle.inertia, *vehicle.products_of_inertia))}"'
    half = reach(vehicle) / math.sqrt(8)
    disc = f"{float(vehicle.propeller_radius)!r} {THICKNESS / 2}"
    sites = "".join(
        f"""
      <site name="motor{motor}" pos="{place}"/>
      <geom type="cylinder" size="{disc}" pos="{place}" rgba="0.3 0.3 0.3 0.6"/>"""
        for motor, place in enumerate(_motor_places(vehicle))
    )
    motors = "".join(
        f"""
    <motor name="motor{motor}" site="motor{motor}" gear="0 0 1 0 0 {float(spin) * ratio!r}" ctrllimited="true"
           ctrlrange="0 {strongest!r}"/>"""
        for motor, spin in enumerate(spins(vehicle))
    )
    if has_curves(vehicle):
        motors += """
    <motor name="yaw" site="centre" gear="0 0 0 0 0 1"/>"""
    if has_body_drag(vehicle):
        for axis, gear in zip("xyz", ("1 0 0 0 0 0", "0 1 0 0 0 0", "0 0 1 0 0 0"), strict=True):
            motors += f"""
    <motor name="drag_{axis}" site="centre" gear="{gear}"/>"""
    return f"""<mujoco model="{_name(vehicle)}">
  <compiler angle="radian" inertiafromgeom="false"/>
  <option timestep="{timestep!r}" integrator="{integrator}" gravity="0 0 {-float(vehicle.gravity)!r}"
          density="0" viscosity="0">
    <flag autoreset="disable"/>
  </option>
  <default>
    <geom contype="0" conaffinity="0" mass="0"/>
  </default>
  <worldbody>
    <light pos="0 0 4"/>
    <body name="body">
      <freejoint name="free"/>
      <inertial pos="0 0 0" mass="{float(vehicle.mass)!r}" {inertia}/>
      <geom type="box" size="{half!r} {half!r} {THICKNESS}" rgba="0.2 0.4 0.7 1"/>
      <site name="centre" pos="0 0 0"/>{sites}
    </body>
  </worldbody>
  <actuator>{motors}
  </actuator>
</mujoco>
"""


def torque_ratio(vehicle: Vehicle) -> float:
    """The drag torque of a rotor over its thrust in m, without linear parts."""
    return float(vehicle.torque_coefficient / vehicle.thrust_coefficient)


def has_curves(vehicle: Vehicle) -> bool:
    """Whether thrust or drag torque of the rotors has a linear part."""
    return vehicle.thrust_linear is not None or vehicle.torque_linear is not None


def _motor_places(vehicle: Vehicle) -> list[str]:
    return [_numbers((x, y, 0.0)) for x, y in places(vehicle)]


def _properties(vehicle: Vehicle) -> str:
    """The attributes of the tag `properties`, those that the vehicle has."""
    drag = vehicle.rotor_drag or (None,) * 3
    given = {
        "kf": vehicle.thrust_coefficient, "kf_linear": vehicle.thrust_linear, "km": vehicle.torque_coefficient,
        "km_linear": vehicle.torque_linear, "min_rpm": vehicle.minimum_rotor_speed_rpm or None,
        "thrust2weight": _thrust_to_weight(vehicle),
        "prop_radius": vehicle.propeller_radius, "gnd_eff_coeff": vehicle.ground_effect, "drag_coeff_xy": drag[0],
        "drag_coeff_z": drag[2],
    }  # fmt: skip
    told = [f'{name}="{float(value)!r}"' for name, value in given.items() if value is not None]
    return " ".join([*told, f'spin="{" ".join(map(str, spins(vehicle)))}"'])


def _thrust_to_weight(vehicle: Vehicle) -> float:
    return float(vehicle.square_of_speed(vehicle.top_rotor_speed_rpm) / vehicle.hover_square)


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _name(vehicle: Vehicle) -> str:
    """The vehicle's name, without the characters that XML does not allow unquoted."""
    return "".join(c for c in vehicle.name if c.isalnum() or c in " -_.@") or "vehicle"
