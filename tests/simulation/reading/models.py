"""Model files as other programs have them, small ones with numbers that can be followed by hand."""

PLACES = ((0.1, -0.12), (-0.1, 0.12), (0.1, 0.12), (-0.1, -0.12))  # front right, rear left, front left, rear right
RING = ((0.1, -0.12), (-0.1, -0.12), (-0.1, 0.12), (0.1, 0.12))  # the same, one after the other
TURNS = ("ccw", "ccw", "cw", "cw")


def urdf(*, properties='kf="1e-8" km="2e-10" thrust2weight="3" prop_radius="0.06"', name="own", links=RING, more=""):
    """As gym-pybullet-drones has it: a body, four links without mass where the propellers are, and `properties`."""
    props = "".join(
        f"""
  <link name="prop{index}_link">
    <inertial><origin rpy="0 0 0" xyz="{x} {y} 0"/><mass value="0"/></inertial>
  </link>
  <joint name="prop{index}_joint" type="fixed"><parent link="base"/><child link="prop{index}_link"/></joint>"""
        for index, (x, y) in enumerate(links)
    )
    tag = f"<properties {properties}/>" if properties else ""
    return f"""<?xml version="1.0"?>
<robot name="{name}">
  {tag}
  <link name="base">
    <inertial>
      <origin rpy="0 0 0" xyz="0 0 0"/>
      <mass value="0.6"/>
      <inertia ixx="2e-3" iyy="3e-3" izz="4e-3" ixy="1e-5" ixz="0" iyz="0"/>
    </inertial>
  </link>{props}{more}
</robot>
"""


def motor(
    index, *, direction=None, link=None, more="", constant="8e-6", plugin="gz-sim-multicopter-motor-model-system"
):
    """A motor model of Gazebo."""
    return f"""
    <plugin filename="{plugin}" name="motor_{index}">
      <jointName>rotor_{index}_joint</jointName>
      <linkName>{link or f"rotor_{index}"}</linkName>
      <turningDirection>{direction or TURNS[index % 4]}</turningDirection>
      <timeConstantUp>0.0125</timeConstantUp>
      <timeConstantDown>0.025</timeConstantDown>
      <maxRotVelocity>1000</maxRotVelocity>
      <motorConstant>{constant}</motorConstant>
      <momentConstant>0.016</momentConstant>
      <motorNumber>{index}</motorNumber>
      <rotorDragCoefficient>8e-05</rotorDragCoefficient>
      {more}
    </plugin>"""


def links(*, places=PLACES, height=0.06, lean=""):
    """A body of 1 kg and a link of 10 g for each rotor, as SDF."""
    rotors = "".join(
        f"""
    <link name="rotor_{index}">
      <pose>{x} {y} {height} {lean or "0 0 0"}</pose>
      <inertial><mass>0.01</mass>
        <inertia><ixx>1e-6</ixx><iyy>2e-6</iyy><izz>3e-6</izz></inertia>
      </inertial>
      <collision name="disc">
        <geometry><cylinder><radius>0.1</radius><length>0.005</length></cylinder></geometry>
      </collision>
    </link>"""
        for index, (x, y) in enumerate(places)
    )
    return f"""
    <link name="base_link">
      <inertial><mass>1.0</mass>
        <inertia><ixx>0.005</ixx><ixy>0</ixy><ixz>0</ixz><iyy>0.006</iyy><iyz>0</iyz><izz>0.009</izz></inertia>
      </inertial>
    </link>{rotors}"""


def sdf(body=None, *, name="own", motors=None):
    """A model of Gazebo."""
    inner = links() if body is None else body
    plugins = "".join(motor(index) for index in range(4)) if motors is None else motors
    return f'<?xml version="1.0"?><sdf version="1.9"><model name="{name}">{inner}{plugins}</model></sdf>'


def mjcf(actuators=None, *, sites=PLACES, option="", geoms=""):
    """A model of MuJoCo: a free body of 1 kg, a site and a motor for each rotor."""
    spins = (-1, -1, 1, 1)
    if actuators is None:
        actuators = "".join(
            f'<motor name="m{i}" site="s{i}" gear="0 0 1 0 0 {0.02 * spins[i]}" ctrllimited="true" ctrlrange="0 5"/>'
            for i in range(len(sites))
        )
    marks = "".join(f'<site name="s{i}" pos="{x} {y} 0.05"/>' for i, (x, y) in enumerate(sites))
    return f"""<mujoco model="own"><compiler angle="radian"/>{option}<worldbody><body name="base" pos="0 0 1">
  <freejoint/><inertial pos="0 0 0" mass="1" diaginertia="0.005 0.006 0.009"/>
  <site name="centre" pos="0 0 0"/>{marks}{geoms}
</body></worldbody><actuator>{actuators}</actuator></mujoco>"""
