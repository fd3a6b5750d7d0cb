"""A picture of one vehicle on its way to its target: a perspective drawing that needs neither a display nor OpenGL."""

import dataclasses
import math
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from flytune.physics.rotors import places, reach
from flytune.physics.vehicle import Vehicle
from flytune.simulation.simulator import VehicleStates, rotation_matrix
from flytune.task.situation import POSITION_BAND
from flytune.task.target import Point

SIZE = 480  # pixels on each side
FINER = 2  # drawn this much larger, then averaged down: smooth edges
FIELD_OF_VIEW = math.radians(38)
AZIMUTH, ELEVATION = math.radians(-142), math.radians(20)  # of the camera, seen from the point that it looks at
NEAREST = 0.05  # m in front of the camera; nearer things are left out
SMALLEST_VEHICLE = 0.2  # of the picture's width, from rotor to rotor; a smaller one is drawn larger and says so

SKY, HORIZON, GROUND = (26, 33, 50), (74, 90, 120), (24, 30, 43)
GRID, AXES = (128, 152, 190), ((235, 96, 96), (110, 205, 130), (105, 160, 255))
TARGET, TRAIL, TEXT, FAINT = (255, 205, 80), (120, 210, 255), (236, 240, 247), (150, 163, 184)
FRAME, FRONT = (214, 220, 230), (255, 108, 92)
THRUST = (84, 150, 255), (205, 225, 235), (255, 150, 60)  # none, hovering, twice as much

Colour = tuple[int, int, int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """What a picture shows."""

    vehicle: Vehicle
    target: Point  # where it is at this instant
    state: VehicleStates  # of one vehicle, without a first axis
    trail: Float[np.ndarray, "steps 3"]  # m, where the vehicle has been, oldest first
    lines: tuple[tuple[str, str], ...]  # of text: name and value

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """The position of the target in m."""
        return np.array(self.target.position, float)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera."""

    eye: Float[np.ndarray, "3"]  # m
    axes: Float[np.ndarray, "3 3"]  # rows: right, up and forward, in the inertial frame
    focal_length: float  # pixels

    def project(self, points: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
        """Where points appear in pixels (x right, y down), and how far in front of the camera they are in metres."""
        seen = (points - self.eye) @ self.axes.T
        depth = np.maximum(seen[..., 2], 1e-3)
        middle = SIZE * FINER / 2
        across = self.focal_length * seen[..., :2] / depth[..., None] * np.array([1.0, -1.0])
        return middle + across, seen[..., 2]


def draw(scene: Scene) -> UInt8[np.ndarray, "480 480 3"]:
    """The picture, red green blue."""
    camera = _camera(scene)
    image = _backdrop(camera)
    pen = ImageDraw.Draw(image, "RGBA")
    _ground(pen, camera, scene)
    _shadow(pen, camera, scene)
    _fading_line(pen, camera, scene.trail, TRAIL, np.linspace(30, 220, len(scene.trail) - 1), 2 * FINER)
    parts = [(scene.place, _target), (scene.state.position, _vehicle)]
    for _, paint in sorted(parts, key=lambda part: -float(camera.project(part[0])[1])):  # the farther first
        paint(pen, camera, scene)
    _text(pen, camera, scene)
    return np.asarray(image.resize((SIZE, SIZE), Image.Resampling.BOX))


def _camera(scene: Scene) -> Camera:
    """The camera that has both the vehicle and its target in the picture, and comes closer as they do."""
    apart = float(np.linalg.norm(scene.state.position - scene.place))
    distance = 0.8 + 1.65 * apart
    middle = (scene.state.position + scene.place) / 2 - np.array([0.0, 0.0, 0.06 * distance])
    outwards = np.array(
        [math.cos(ELEVATION) * math.cos(AZIMUTH), math.cos(ELEVATION) * math.sin(AZIMUTH), math.sin(ELEVATION)]
    )
    right = np.array([-math.sin(AZIMUTH), math.cos(AZIMUTH), 0.0])
    eye = middle + distance * outwards
    return Camera(
        eye=np.array([eye[0], eye[1], max(eye[2], 0.15)]),  # never under the ground
        axes=np.stack([right, np.cross(outwards, right), -outwards]),
        focal_length=SIZE * FINER / 2 / math.tan(FIELD_OF_VIEW / 2),
    )


def _backdrop(camera: Camera) -> Image.Image:
    """Sky and ground, which meet where the camera looks level."""
    level = camera.eye + 1e4 * np.array([-math.cos(AZIMUTH), -math.sin(AZIMUTH), 0.0])
    horizon = round(float(camera.project(level)[0][1]))
    rows = np.arange(SIZE * FINER)[:, None]
    sky = np.clip(rows / max(horizon, 1), 0, 1) ** 2
    ground = np.clip((rows - horizon) / (0.55 * SIZE * FINER), 0, 1) ** 0.5
    upper = np.array(SKY) + sky * (np.array(HORIZON) - np.array(SKY))
    lower = np.array(HORIZON) + ground * (np.array(GROUND) - np.array(HORIZON))
    column = np.where(rows < horizon, upper, lower).round().astype(np.uint8)
    return Image.fromarray(column[:, None]).resize((SIZE * FINER, SIZE * FINER), Image.Resampling.NEAREST)


def _ground(pen: Any, camera: Camera, scene: Scene) -> None:
    """A grid on the ground, a line every half metre, brighter every metre, that fades into the distance."""
    centre = np.array([*np.round(scene.place[:2]), 0.0])
    offsets = np.linspace(-6, 6, 25)
    for index, offset in enumerate(offsets):
        line = np.stack([offsets, np.full_like(offsets, offset), np.zeros_like(offsets)], axis=-1)
        for points in (centre + line, centre + line[:, [1, 0, 2]]):
            ahead = np.linalg.norm(points[1:, :2] - camera.eye[:2], axis=-1)
            shades = (120 if index % 2 == 0 else 55) * np.exp(-((ahead / 5.0) ** 2))
            _fading_line(pen, camera, points, GRID, shades, FINER)
    for axis in (0, 1):  # x red and y green, from the origin
        end = np.zeros(3)
        end[axis] = 0.5
        _line(pen, camera, np.stack([np.zeros(3), end]), (*AXES[axis], 200), 1.5)


def _shadow(pen: Any, camera: Camera, scene: Scene) -> None:
    """The points on the ground below vehicle and target, and dashed lines up to them."""
    size = reach(scene.vehicle)
    shown = ((scene.state.position, (0, 0, 0), FRAME, 1.6 * size), (scene.place, TARGET, TARGET, size))
    for place, shadow, colour, radius in shown:
        below = np.array([place[0], place[1], 0.0])
        _polygon(pen, camera, below + _circle(radius, np.eye(3)), (*shadow, 90))
        for share in np.arange(0, 1, 0.05):  # a dashed plumb line
            piece = below + np.array([[share], [share + 0.022]]) * (place - below)
            _line(pen, camera, piece, (*colour, 70), 1.0)


def _target(pen: Any, camera: Camera, scene: Scene) -> None:
    """The band as a circle, and the wanted heading and axes as a cross."""
    (x, y), depth = camera.project(scene.place)
    if depth < NEAREST:
        return
    c, s = math.cos(scene.target.yaw), math.sin(scene.target.yaw)
    for direction, colour in zip(([c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]), AXES, strict=True):
        _line(pen, camera, scene.place + np.outer([0.0, 0.16], direction), (*colour, 235), 1.6)
    radius = max(camera.focal_length * POSITION_BAND / float(depth), 3.0 * FINER)
    box = (x - radius, y - radius, x + radius, y + radius)
    pen.ellipse(box, fill=(*TARGET, 60), outline=(*TARGET, 255), width=round(1.5 * FINER))


def _enlargement(camera: Camera, scene: Scene) -> float:
    """How many times larger than life the vehicle is drawn: 1 where it can be seen well as it is."""
    depth = max(float(camera.project(scene.state.position)[1]), NEAREST)
    width = camera.focal_length * 2 * (reach(scene.vehicle) + float(scene.vehicle.propeller_radius)) / depth
    return max(1.0, SMALLEST_VEHICLE * SIZE * FINER / width)


def _vehicle(pen: Any, camera: Camera, scene: Scene) -> None:
    """Arms, rotors whose colour and stalk show their thrust, and a nose; the front is red."""
    position, vehicle = scene.state.position, scene.vehicle
    if camera.project(position)[1] < NEAREST:
        return
    scale, rotors = _enlargement(camera, scene), places(vehicle)
    size = scale * reach(vehicle)
    axes = rotation_matrix(scene.state.attitude[None])[0]  # columns: the body's axes in the inertial frame
    hubs = position + scale * rotors @ axes[:, :2].T
    lift = 0.12 * size * axes[:, 2]
    for rotor, hub in zip(rotors, hubs, strict=True):
        _line(pen, camera, np.stack([position, hub]), (*(FRONT if rotor[0] > 0 else FRAME), 255), 3.0)
        _line(pen, camera, np.stack([hub, hub + lift]), (*FRAME, 255), 2.5)
    _polygon(pen, camera, position + _circle(0.34 * size, axes), (44, 50, 62, 255), FRAME)
    nose = np.array([[0.95, 0, 0], [0.28, 0.22, 0], [0.28, -0.22, 0]]) * size
    _polygon(pen, camera, position + nose @ axes.T, (*FRONT, 255))
    thrusts = (scene.state.rotor_speed_rpm / vehicle.hover_rotor_speed_rpm) ** 2  # over their share of the weight
    for motor in np.argsort(-camera.project(hubs)[1]):  # the farther rotor first
        colour = _thrust_colour(float(thrusts[motor]))
        disc = hubs[motor] + lift + _circle(scale * float(vehicle.propeller_radius), axes)
        _polygon(pen, camera, disc, (*colour, 105), colour)
        stalk = np.outer([0.0, 0.55 * size * float(thrusts[motor])], axes[:, 2])
        _line(pen, camera, hubs[motor] + lift + stalk, (*colour, 255), 2.0)


def _thrust_colour(thrust: float) -> Colour:
    red, green, blue = (round(float(np.interp(thrust, (0, 1, 2), levels))) for levels in np.array(THRUST).T)
    return red, green, blue


def _text(pen: Any, camera: Camera, scene: Scene) -> None:
    small, step = 13 * FINER, 19 * FINER
    left, top = 16 * FINER, 14 * FINER
    panel = (left - 6 * FINER, top - 5 * FINER, left + 158 * FINER, top + step * len(scene.lines) + 2 * FINER)
    pen.rounded_rectangle(panel, radius=6 * FINER, fill=(10, 14, 22, 130))
    for row, (name, value) in enumerate(scene.lines):
        height = top + row * step
        pen.text((left, height), name, font=_font(small), fill=(*FAINT, 255))
        pen.text((left + 152 * FINER, height), value, font=_font(small), fill=(*TEXT, 255), anchor="ra")
    if (scale := _enlargement(camera, scene)) > 1.05:
        note = f"vehicle drawn {scale:.1f} times its size"
        pen.text((left, (SIZE - 26) * FINER), note, font=_font(11 * FINER), fill=(*FAINT, 255))


@lru_cache(maxsize=4)
def _font(size: int) -> Any:
    return ImageFont.load_default(size)


def _fading_line(
    pen: Any, camera: Camera, points: Float[np.ndarray, "n 3"], colour: Colour, shades: np.ndarray, width: int
) -> None:
    """A line whose pieces have the opacities `shades`, 0 to 255."""
    pixels, depth = camera.project(points)
    seen = (np.minimum(depth[1:], depth[:-1]) > NEAREST) & (shades > 1)
    pieces = np.concatenate([pixels[:-1], pixels[1:]], axis=-1)[seen].tolist()
    for piece, shade in zip(pieces, shades[seen].tolist(), strict=True):
        pen.line(piece, fill=(*colour, int(shade)), width=width)


def _line(pen: Any, camera: Camera, points: Float[np.ndarray, "2 3"], fill: tuple[int, ...], width: float) -> None:
    pixels, depth = camera.project(points)
    if depth.min() > NEAREST:
        pen.line([*pixels[0], *pixels[1]], fill=fill, width=round(width * FINER))


def _polygon(
    pen: Any, camera: Camera, points: Float[np.ndarray, "n 3"], fill: tuple[int, ...], outline: Colour | None = None
) -> None:
    pixels, depth = camera.project(points)
    if depth.min() > NEAREST:
        corners = [tuple(corner) for corner in pixels]
        pen.polygon(corners, fill=fill)
        if outline is not None:
            pen.line([*corners, corners[0]], fill=(*outline, 230), width=FINER, joint="curve")


def _circle(radius: float, axes: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 3"]:
    """The points of a circle about the third of the axes (columns)."""
    angle = np.linspace(0, 2 * math.pi, 36, endpoint=False)
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1) @ axes.T
