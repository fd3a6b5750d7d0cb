"""Evidence made by hand: first-order responses whose settling times are known."""

import dataclasses

import numpy as np
import pytest

from flytune.evaluation.flights import Flights
from flytune.evaluation.judge import judge
from flytune.reproduction.evidence import SETTINGS, WEIGHTS_FILES, BehaviourResponse, Evidence
from flytune.reproduction.study import BEHAVIOURS, Study

TARGET = np.array([0.0, 0.0, 1.0])
DISTANCES = np.linspace(0.5, 2.0, 20)  # m, of the trials along x


def first_order(constant, offset=0.0, duration=10.0, task="baseline", speed_bound=None):
    """Flights along x, e(t) = distance * exp(-t / constant) + offset, everything else on target."""
    time = np.arange(round(duration * 100) + 1) / 100
    error = np.zeros((DISTANCES.size, time.size, 3))
    error[:, :, 0] = DISTANCES[:, None] * np.exp(-time / constant) + offset
    shape = error.shape[:2]
    return Flights(
        time=time,
        position=error + TARGET,
        attitude=np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*shape, 4)),
        velocity=np.zeros((*shape, 3)),
        body_rate=np.zeros((*shape, 3)),
        rotor_speed_rpm=np.full((*shape, 4), 16_004.0),
        action=np.broadcast_to((-1.0) ** np.arange(time.size)[:, None] / constant, (*shape, 4)),
        crashed=np.zeros(DISTANCES.size, bool),
        margins={"speed": np.ones(shape)},
        target_position=TARGET,
        target_yaw=0.0,
        speed_bound=speed_bound,
        name="hand",
        task=task,
        vehicle="crazyflie",
        simulator="flytune",
        seed=1,
        initial_conditions="clear",
    )


def curve(final, steps_per_row=100_000, rows=60, survives_after=7, horizon=500):
    """A training whose reward rises linearly for half of it and then stays, and that survives after some rows."""
    return [
        {
            "steps": (number + 1) * steps_per_row,
            "episode_reward": final * min(1.0, (number + 1) / (rows / 2)),
            "episode_length": horizon if number + 1 >= survives_after else horizon / 10,
            "episodes": 10,
            "terminations": {"attitude": 0, "speed": 1},
        }
        for number in range(rows)
    ]


@pytest.fixture
def make_evidence(tmp_path):
    """Factory of Evidence from one time constant (s) and one offset (m) per behaviour, two seeds alike."""

    def make(constants, offsets=None, curves=None):
        study = Study(folder=tmp_path / "study", seeds=2)
        responses = {}
        for behaviour in BEHAVIOURS:
            flights = first_order(constants[behaviour], (offsets or {}).get(behaviour, 0.0))
            judgement = judge(flights)
            ways = np.abs(flights.position[:, [0, -1], 0])
            response = BehaviourResponse(
                judgements=[judgement, judgement],
                flights=flights,
                rotor_speed=np.full((2, DISTANCES.size), 16_004.0),
                progress=np.tile(1 - ways[:, 1] / ways[:, 0], (2, 1)),
                distance=np.tile(ways[:, 0], (2, 1)),
            )
            for weights in WEIGHTS_FILES:
                for setting in SETTINGS:
                    responses[behaviour, weights, setting.name] = response
        return Evidence(
            study=study,
            tasks={behaviour: study.task(behaviour) for behaviour in BEHAVIOURS},
            responses=responses,
            curves=curves or {behaviour: [curve(100.0), curve(101.0)] for behaviour in BEHAVIOURS},
        )

    return make


@pytest.fixture
def change_response():
    """A response with other judgements."""
    return lambda response, judgements: dataclasses.replace(response, judgements=judgements)
