"""A picture of one vehicle on its way to its target: a perspective drawing that needs neither a display nor OpenGL."""

import dataclasses
import math
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

SIZE = 480  # pixels on each side
FINER = 2  # drawn this much larger, then averaged down: smooth edges
FIELD_OF_VIEW = math.radians(38)
AZIMUTH, ELEVATION = math.radians(-142), math.radians(20)  # of the camera, seen from what it looks at
NEAREST = 0.05  # m in front of the camera; what is nearer is left out
SMALLEST_VEHICLE = 0.2  # of the picture's width, from rotor to rotor; a smaller one is drawn larger and says so

SKY, HORIZON, GROUND = (26, 33, 50), (74, 90, 120), (24, 30, 43)
GRID, AXES = (128, 152, 190), ((235, 96, 96), (110, 205, 130), (105, 160, 255))
TARGET, TRAIL, TEXT, FAINT = (255, 205, 80), (120, 210, 255), (236, 240, 247), (150, 163, 184)
FRAME, FRONT = (214, 220, 230), (255, 108, 92)
WEAK, HOVERING, STRONG = (84, 150, 255), (205, 225, 235), (255, 150, 60)  # thrust

Colour = tuple[int, int, int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene:
    """What a picture shows."""

    position: Float[np.ndarray, "3"]  # m
    attitude: Float[np.ndarray, "4"]  # unit quaternion (x, y, z, w), body to inertial
    thrust: Float[np.ndarray, "4"]  # of each motor, over its share of the weight
    rotors: Float[np.ndarray, "4 2"]  # m, where they stand in the body frame
    propeller_radius: float  # m
    target: Float[np.ndarray, "3"]  # m
    target_yaw: float  # rad
    band: float  # m, radius of the sphere around the target that counts as settled
    trail: Float[np.ndarray, "steps 3"]  # m, where the vehicle has been, oldest first
    lines: tuple[tuple[str, str], ...]  # what is written: name and value

    @property
    def reach(self) -> float:
        """Distance of the farthest rotor from the centre in m."""
        return float(np.linalg.norm(self.rotors, axis=1).max())


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
    scale = _enlargement(camera, scene)
    parts = [
        (camera.project(scene.target)[1], lambda: _target(pen, camera, scene)),
        (camera.project(scene.position)[1], lambda: _vehicle(pen, camera, scene, scale)),
    ]
    _trail(pen, camera, scene)
    for _, paint in sorted(parts, key=lambda part: -float(part[0])):  # the farther first
        paint()
    _text(pen, scene, scale)
    return np.asarray(image.resize((SIZE, SIZE), Image.Resampling.BOX))


def _camera(scene: Scene) -> Camera:
    """The camera that has both the vehicle and its target in the picture, and comes closer as they do."""
    apart = float(np.linalg.norm(scene.position - scene.target))
    distance = 0.8 + 1.65 * apart
    middle = (scene.position + scene.target) / 2 - np.array([0.0, 0.0, 0.06 * distance])
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
    return _gradient(round(float(camera.project(level)[0][1]))).copy()


@lru_cache(maxsize=4)
def _gradient(horizon: int) -> Image.Image:
    rows = np.arange(SIZE * FINER)[:, None]
    sky = np.clip(rows / max(horizon, 1), 0, 1) ** 2
    ground = np.clip((rows - horizon) / (0.55 * SIZE * FINER), 0, 1) ** 0.5
    upper = np.array(SKY) + sky * (np.array(HORIZON) - np.array(SKY))
    lower = np.array(HORIZON) + ground * (np.array(GROUND) - np.array(HORIZON))
    column = np.where(rows < horizon, upper, lower)
    return Image.fromarray(np.repeat(column[:, None], SIZE * FINER, axis=1).round().astype(np.uint8))


def _ground(pen: Any, camera: Camera, scene: Scene) -> None:
    """A grid on the ground, a line every half metre, brighter every metre, that fades into the distance."""
    centre = np.round(scene.target[:2])
    reach = 6
    for index in range(-2 * reach, 2 * reach + 1):
        offset = index / 2
        along = np.linspace(-reach, reach, 25)
        across = np.full_like(along, offset)
        for first, second in ((along, across), (across, along)):
            line = np.stack([centre[0] + first, centre[1] + second, np.zeros_like(along)], axis=-1)
            _fading_line(pen, camera, line, 120 if index % 2 == 0 else 55)
    for axis in (0, 1):  # x red and y green, from the origin
        end = np.zeros(3)
        end[axis] = 0.5
        _line(pen, camera, np.stack([np.zeros(3), end]), (*AXES[axis], 200), 1.5)


def _fading_line(pen: Any, camera: Camera, line: Float[np.ndarray, "n 3"], opacity: int) -> None:
    pixels, depth = camera.project(line)
    ahead = np.linalg.norm(line[:, :2] - camera.eye[:2], axis=-1)
    shades = opacity * np.exp(-((ahead / 5.0) ** 2))
    seen = (np.minimum(depth[1:], depth[:-1]) > NEAREST) & (shades[1:] > 1)
    pieces = np.concatenate([pixels[:-1], pixels[1:]], axis=-1)[seen].tolist()
    for piece, shade in zip(pieces, shades[1:][seen].tolist(), strict=True):
        pen.line(piece, fill=(*GRID, int(shade)), width=FINER)


def _shadow(pen: Any, camera: Camera, scene: Scene) -> None:
    """Where vehicle and target stand over the ground, and how high."""
    for place, colour, radius in ((scene.position, (0, 0, 0), 1.6 * scene.reach), (scene.target, TARGET, scene.reach)):
        below = np.array([place[0], place[1], 0.0])
        ring = below + _circle(radius, np.eye(3))
        _polygon(pen, camera, ring, (*colour, 90))
        for share in np.arange(0, 1, 0.05):  # a dashed plumb line
            piece = below + np.array([[share], [share + 0.022]]) * (place - below)
            _line(pen, camera, piece, (*(TARGET if colour == TARGET else FRAME), 70), 1.0)


def _trail(pen: Any, camera: Camera, scene: Scene) -> None:
    pixels, depth = camera.project(scene.trail)
    seen = (depth[1:] > NEAREST) & (depth[:-1] > NEAREST)
    shades = np.linspace(30, 220, len(seen))[seen].tolist()
    for piece, shade in zip(np.concatenate([pixels[:-1], pixels[1:]], axis=-1)[seen].tolist(), shades, strict=True):
        pen.line(piece, fill=(*TRAIL, int(shade)), width=2 * FINER)


def _target(pen: Any, camera: Camera, scene: Scene) -> None:
    """The band as a circle, and the wanted heading and axes as a cross."""
    (x, y), depth = camera.project(scene.target)
    if depth < NEAREST:
        return
    for axis, colour in enumerate(AXES):
        turned = scene.target_yaw + (math.pi / 2 if axis == 1 else 0.0)
        direction = np.array([math.cos(turned), math.sin(turned), 0.0]) if axis < 2 else np.array([0.0, 0.0, 1.0])
        _line(pen, camera, scene.target + np.outer([0.0, 0.16], direction), (*colour, 235), 1.6)
    radius = max(camera.focal_length * scene.band / float(depth), 3.0 * FINER)
    box = (x - radius, y - radius, x + radius, y + radius)
    pen.ellipse(box, fill=(*TARGET, 60), outline=(*TARGET, 255), width=round(1.5 * FINER))


def _enlargement(camera: Camera, scene: Scene) -> float:
    """How many times larger than life the vehicle is drawn: 1 where it can be seen well as it is."""
    depth = max(float(camera.project(scene.position)[1]), NEAREST)
    width = camera.focal_length * 2 * (scene.reach + scene.propeller_radius) / depth
    return max(1.0, SMALLEST_VEHICLE * SIZE * FINER / width)


def _vehicle(pen: Any, camera: Camera, scene: Scene, scale: float) -> None:
    """Arms, rotors whose colour and stalk tell their thrust, and a nose; the front is red."""
    if camera.project(scene.position)[1] < NEAREST:
        return
    axes = _matrix(scene.attitude)  # columns: the body's axes in the inertial frame
    hubs = scene.position + scale * scene.rotors @ axes[:, :2].T
    lift = 0.12 * scale * scene.reach * axes[:, 2]
    for motor, hub in enumerate(hubs):
        colour = FRONT if scene.rotors[motor, 0] > 0 else FRAME
        _line(pen, camera, np.stack([scene.position, hub]), (*colour, 255), 3.0)
        _line(pen, camera, np.stack([hub, hub + lift]), (*FRAME, 255), 2.5)
    _polygon(pen, camera, scene.position + _circle(0.34 * scale * scene.reach, axes), (44, 50, 62, 255), FRAME)
    nose = np.array([[0.95, 0, 0], [0.28, 0.22, 0], [0.28, -0.22, 0]]) * scale * scene.reach
    _polygon(pen, camera, scene.position + nose @ axes.T, (*FRONT, 255))
    depth = camera.project(hubs)[1]
    for motor in np.argsort(-depth):  # the farther rotor first
        thrust = float(np.clip(scene.thrust[motor], 0, 2))
        colour = _mix(WEAK, HOVERING, thrust) if thrust < 1 else _mix(HOVERING, STRONG, thrust - 1)
        disc = hubs[motor] + lift + _circle(scale * scene.propeller_radius, axes)
        _polygon(pen, camera, disc, (*colour, 105), colour)
        stalk = np.outer([0.0, 0.55 * scale * scene.reach * float(scene.thrust[motor])], axes[:, 2])
        _line(pen, camera, hubs[motor] + lift + stalk, (*colour, 255), 2.0)


def _text(pen: Any, scene: Scene, scale: float) -> None:
    small, step = 13 * FINER, 19 * FINER
    left, top = 16 * FINER, 14 * FINER
    panel = (left - 6 * FINER, top - 5 * FINER, left + 158 * FINER, top + step * len(scene.lines) + 2 * FINER)
    pen.rounded_rectangle(panel, radius=6 * FINER, fill=(10, 14, 22, 130))
    for row, (name, value) in enumerate(scene.lines):
        height = top + row * step
        pen.text((left, height), name, font=_font(small), fill=(*FAINT, 255))
        pen.text((left + 152 * FINER, height), value, font=_font(small), fill=(*TEXT, 255), anchor="ra")
    if scale > 1.05:
        note = f"vehicle drawn {scale:.1f} times its size"
        pen.text((left, (SIZE - 26) * FINER), note, font=_font(11 * FINER), fill=(*FAINT, 255))


@lru_cache(maxsize=4)
def _font(size: int) -> Any:
    return ImageFont.load_default(size)


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


def _matrix(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """The rotation matrix of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _mix(first: Colour, second: Colour, share: float) -> Colour:
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, second, strict=True))
    return red, green, blue
