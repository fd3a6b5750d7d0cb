"""Pictures: what is to be seen is there, and where it belongs."""

import dataclasses
import math

import numpy as np
import pytest

pytest.importorskip("PIL", reason="needs flytune[gymnasium]")

from flytune.adapters import picture
from flytune.adapters.picture import FINER, SIZE, TARGET, Scene, draw
from flytune.simulation.simulator import VehicleStates
from flytune.task.files import load_task

PLACE = np.array([0.3, -0.2, 1.2])


@pytest.fixture
def scene():
    """A vehicle near its target that has not moved yet, with nothing written."""
    task = load_task("baseline")
    state = VehicleStates(
        position=PLACE,
        attitude=np.array([0.0, 0.0, 0.0, 1.0]),
        velocity=np.zeros(3),
        body_rate=np.zeros(3),
        rotor_speed_rpm=np.full(4, task.vehicle.hover_rotor_speed_rpm),
    )
    return Scene(vehicle=task.vehicle, target=task.target, state=state, trail=PLACE[None], lines=())


def moved(scene, **fields):
    """The scene with another state of its vehicle."""
    return dataclasses.replace(scene, state=dataclasses.replace(scene.state, **fields))


def changed(scene, other):
    """The picture's pixels that another scene draws differently, [480, 480] bool."""
    return (draw(scene) != draw(other)).any(axis=-1)


def pixel(scene, point):
    """Column and row of a point in the picture."""
    return picture._camera(scene).project(np.asarray(point, float))[0] / FINER


def like(image, colour, tolerance=60):
    """Rows and columns of the pixels close to a colour."""
    return np.argwhere(np.abs(image.astype(int) - colour).sum(axis=-1) < tolerance)


def test_a_picture_is_rgb_and_not_blank(scene):
    image = draw(scene)
    assert image.shape == (SIZE, SIZE, 3) and image.dtype == np.uint8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 200


def test_the_target_is_drawn_where_the_camera_sees_it(scene):
    spots = like(draw(scene), TARGET)
    assert len(spots) > 10
    # the ring around it is a band of 2 cm: some ten pixels
    assert np.abs(spots.mean(axis=0)[::-1] - pixel(scene, scene.place)).max() < 12


def test_the_vehicle_is_drawn_where_the_camera_sees_it(scene):
    # its own attitude changes no other part of the picture, so what changes is the vehicle
    spots = np.argwhere(changed(scene, moved(scene, attitude=np.array([0.0, 0.0, math.sin(0.4), math.cos(0.4)]))))
    assert len(spots) > 200
    assert np.abs(spots.mean(axis=0)[::-1] - pixel(scene, scene.state.position)).max() < 12


def test_the_camera_keeps_both_in_the_picture_and_level_above_the_ground(scene):
    for position in np.random.default_rng(0).uniform([-2, -2, 0.05], [2, 2, 2.5], (50, 3)):
        scene = moved(scene, position=position)
        places = np.array([pixel(scene, position), pixel(scene, scene.place)])
        assert places.min() > 0 and places.max() < SIZE
        assert picture._camera(scene).eye[2] > 0
        up, more = pixel(scene, [0, 0, 1.0]), pixel(scene, [0, 0, 1.1])
        assert more[1] < up[1]  # up is up


def test_the_front_is_red_and_points_where_the_vehicle_does(scene):
    there = moved(scene, position=scene.place + np.array([0.5, 0, 0]))
    for quarters, front in enumerate(([1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0])):
        half = quarters * math.pi / 4
        seen = moved(there, attitude=np.array([0.0, 0.0, math.sin(half), math.cos(half)]))
        red, green, blue = np.moveaxis(draw(seen).astype(int), -1, 0)
        middle = pixel(seen, seen.state.position)
        spots = np.argwhere((red - green > 50) & (red - blue > 50))[:, ::-1]  # also through a rotor's disc
        near = spots[np.linalg.norm(spots - middle, axis=1) < 60]
        wanted = pixel(seen, seen.state.position + 0.03 * np.array(front)) - middle
        assert len(near) > 10
        assert (near.mean(axis=0) - middle) @ wanted > 0


def test_rotors_show_their_thrust(scene):
    hover = scene.state.rotor_speed_rpm
    red = [draw(moved(scene, rotor_speed_rpm=hover * math.sqrt(thrust))) for thrust in (0.2, 1.0, 1.8)]
    middle = pixel(scene, scene.state.position).astype(int)
    window = [image[middle[1] - 60 : middle[1] + 30, middle[0] - 60 : middle[0] + 60].astype(int) for image in red]
    warmth = [float((part[..., 0] - part[..., 2]).mean()) for part in window]  # red over blue
    assert warmth[0] < warmth[1] < warmth[2]


def test_the_trail_is_drawn_where_the_vehicle_has_been(scene):
    way = PLACE + np.linspace([0.3, 0.3, 0.1], [0, 0, 0], 40)
    spots = changed(scene, dataclasses.replace(scene, trail=way))
    columns, rows = pixel(scene, way).round().astype(int).T
    assert spots[rows[:-8], columns[:-8]].all()  # the last few lie behind the vehicle
    assert spots.sum() < 2500  # and nothing else is


def test_what_is_written_is_seen_in_its_corner_only(scene):
    spots = np.argwhere(changed(scene, dataclasses.replace(scene, lines=(("time", "1.23 s"), ("reward", "0.5")))))
    assert len(spots) > 100
    assert spots[:, 0].max() < 60 and spots[:, 1].max() < 190  # rows, columns
    written = dataclasses.replace(scene, lines=(("time", "1.23 s"),))
    assert changed(written, dataclasses.replace(scene, lines=(("time", "4.56 s"),))).any()


def test_a_vehicle_too_far_to_be_seen_is_drawn_larger_and_says_so(scene):
    near, far = moved(scene, position=scene.place + 0.01), moved(scene, position=np.array([2.0, 2.0, 2.0]))
    camera = picture._camera
    assert picture._enlargement(camera(near), near) == 1.0
    assert picture._enlargement(camera(far), far) > 3
    note = draw(far)[SIZE - 26 : SIZE - 10, 16:200]
    assert len(like(note, picture.FAINT, 120)) > 40


@pytest.mark.parametrize("place", [[1e3, -1e3, 1e3], [0, 0, -5], [0, 0, 1]])
def test_the_strangest_places_still_give_a_picture(scene, place):
    there = moved(scene, position=np.array(place, float))
    image = draw(dataclasses.replace(there, trail=np.array([PLACE, place], float)))
    assert image.shape == (SIZE, SIZE, 3) and image.std() > 1
