"""Flights: recorded trajectories, which are all that the judge knows of a controller. NumPy only."""

import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flytune.config.files import write_bytes

MARK = b"target_yaw.npy"  # in every file that `Flights.save` writes, near its end

COLUMNS = {  # per sample: the unit of a field, and the names of its columns in a file
    "position": ("m", "x y z"),
    "attitude": ("1", "qx qy qz qw"),
    "velocity": ("m/s", "vx vy vz"),
    "body_rate": ("rad/s", "wx wy wz"),
    "rotor_speed_rpm": ("rpm", "rpm0 rpm1 rpm2 rpm3"),
    "action": ("1", "a0 a1 a2 a3"),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Labels:
    """The controller that flew, and its task, vehicle, simulator and initial conditions."""

    name: str  # as the user named it
    task: str
    vehicle: str
    simulator: str
    seed: int | None  # None for flights that were logged elsewhere
    initial_conditions: str  # "clear" or "paper"; "as logged" elsewhere
    dial: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # dial -> value, or its pairs [time in s, value]
    made_for: str = ""  # the vehicle that a policy was trained on, where another one flew
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # field path -> what was met in its place


@dataclasses.dataclass(frozen=True, kw_only=True)
class Flights(Labels):
    """True trajectories of N trials, sampled at the control rate from the start (sample 0) to the end, T + 1 samples.

    A trial that crashed (left a ball of 10 m around the target, or stopped being finite) holds its last state from
    there on; `crashed` says which ones did.
    """

    time: np.ndarray  # [T + 1] s, from 0, evenly spaced
    position: np.ndarray  # [N, T + 1, 3] m, inertial frame, z up
    attitude: np.ndarray  # [N, T + 1, 4] unit quaternion (x, y, z, w), body to inertial
    velocity: np.ndarray  # [N, T + 1, 3] m/s, inertial frame
    body_rate: np.ndarray  # [N, T + 1, 3] rad/s, body frame
    rotor_speed_rpm: np.ndarray  # [N, T + 1, 4] rpm
    action: np.ndarray  # [N, T + 1, 4] in [-1, 1]; sample k is the action that led to sample k, sample 0 is hover (0)
    crashed: np.ndarray  # [N] bool
    margins: dict[str, np.ndarray]  # termination name -> [N, T + 1], share of the bound left, negative beyond it
    target_position: np.ndarray  # [3] m; of a target that moves [T + 1, 3]
    target_yaw: Any  # rad; of a target that moves [T + 1]
    speed_bound: float | None  # m/s, of the task's speed termination; None where it has none
    missing: tuple[str, ...] = ()  # fields that a log lacks, of `velocity` and those below it; they are NaN

    def __repr__(self) -> str:
        crashed = f", {np.count_nonzero(self.crashed)} crashed" if self.crashed.any() else ""
        return (
            f"Flights({self.name or 'controller'} on {self.task}, {self.trials} trials of {self.duration:g} s{crashed})"
        )

    @property
    def trials(self) -> int:
        """Number of trials N."""
        return self.position.shape[0]

    @property
    def duration(self) -> float:
        """Length of each trial in seconds."""
        return float(self.time[-1])

    @property
    def moving(self) -> bool:
        """Whether the target moves, or steps."""
        return self.target_position.ndim == 2

    @property
    def start_error(self) -> np.ndarray:
        """The way from the target to each start, [N, 3] in m, where the target is at the start."""
        return self.position[:, 0] - (self.target_position[0] if self.moving else self.target_position)

    @property
    def steps(self) -> list["Flights"]:
        """The flights to each place of a target that steps, each from time 0 on; none of one that moves otherwise.

        A trial counts as crashed in the step in which it crashed, and in those that follow.
        """
        if not self.moving:
            return []
        changed = np.diff(np.column_stack([self.target_position, self.target_yaw]), axis=0).any(axis=1)
        begins = [0, *(np.flatnonzero(changed) + 1).tolist()]
        if (np.diff(begins) < 2).any():
            return []
        held = (self.position == self.position[:, -1:]).all(axis=-1)
        lost = np.where(held.all(axis=1), 0, held.shape[1] - np.argmin(held[:, ::-1], axis=1))  # the first held sample
        ends = [*begins[1:], self.time.size]
        return [
            self._part(slice(begin, end), self.crashed & (lost < end)) for begin, end in zip(begins, ends, strict=True)
        ]

    def _part(self, part: slice, crashed: np.ndarray) -> "Flights":
        fields = {name: getattr(self, name)[:, part] for name in COLUMNS}
        return dataclasses.replace(
            self,
            **fields,
            time=np.round(self.time[part] - self.time[part.start], 9),
            crashed=crashed,
            margins={name: margin[:, part] for name, margin in self.margins.items()},
            target_position=self.target_position[part.start],
            target_yaw=float(self.target_yaw[part.start]),
        )

    def save(self, path: Path) -> None:
        """Write the trajectories as .npz: `data` [N, T + 1, C] with `columns` [C], `units` [C] and labels.

        Raises:
            BadInput: the file cannot be written.
        """
        columns = {"time": ("s", np.broadcast_to(self.time, self.position.shape[:2]))}
        for field, (unit, names) in COLUMNS.items():
            if field in self.missing:
                continue
            parts = np.moveaxis(getattr(self, field), -1, 0)
            columns |= {name: (unit, part) for name, part in zip(names.split(), parts, strict=True)}
        columns |= {f"margin_{name}": ("1", margin) for name, margin in self.margins.items()}
        content = io.BytesIO()
        np.savez_compressed(
            content,
            data=np.stack([values for _, values in columns.values()], axis=-1).astype(np.float32),
            columns=np.array(list(columns)),
            units=np.array([unit for unit, _ in columns.values()]),
            time=self.time,
            speed_bound=np.nan if self.speed_bound is None else self.speed_bound,
            crashed=self.crashed,
            target_position=self.target_position,
            target_yaw=self.target_yaw,
            who=self.name,
            task=self.task,
            vehicle=self.vehicle,
            world=self.simulator,
            seed=-1 if self.seed is None else self.seed,
            starts=self.initial_conditions,
            dial=json.dumps(dict(self.dial)),
            made_for=self.made_for,
            changes=json.dumps(dict(self.changes)),
        )
        write_bytes(path, content.getvalue(), "flights")

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "Flights":
        """The flights that `save` has written, from its arrays; they are judged to exactly the same numbers.

        Raises:
            KeyError, ValueError: an array is missing or has another shape.
        """
        data, names = np.asarray(arrays["data"]), [str(name) for name in arrays["columns"]]
        trials, samples, _ = data.shape
        fields, missing = {}, []
        for field, (_, columns) in COLUMNS.items():
            wanted = columns.split()
            if field not in ("position", "attitude") and not set(wanted) & set(names):
                missing.append(field)
                fields[field] = np.full((trials, samples, len(wanted)), np.nan)
            else:
                fields[field] = data[..., [names.index(name) for name in wanted]]
        margins = {name.removeprefix("margin_"): data[..., index] for index, name in enumerate(names)
                   if name.startswith("margin_")}  # fmt: skip
        seed, bound, position = int(arrays["seed"]), float(arrays["speed_bound"]), np.asarray(arrays["target_position"])
        time, crashed = np.asarray(arrays["time"], np.float64), np.asarray(arrays["crashed"], bool)
        if (
            time.shape != (samples,)
            or crashed.shape != (trials,)
            or position.shape
            not in (
                (3,),
                (samples, 3),
            )
        ):
            raise ValueError(f"time {time.shape}, crashed {crashed.shape} or target_position {position.shape}")
        return cls(
            **fields,
            time=time,
            crashed=crashed,
            margins=margins,
            target_position=position,
            target_yaw=np.asarray(arrays["target_yaw"], np.float64)
            if position.ndim == 2
            else float(arrays["target_yaw"]),
            speed_bound=None if np.isnan(bound) else bound,
            missing=tuple(missing),
            name=str(arrays["who"]),
            task=str(arrays["task"]),
            vehicle=str(arrays["vehicle"]),
            simulator=str(arrays["world"]),
            seed=None if seed < 0 else seed,
            initial_conditions=str(arrays["starts"]),
            dial=json.loads(str(arrays["dial"])),
            made_for=str(arrays["made_for"]),
            changes=json.loads(str(arrays["changes"])) if "changes" in arrays else {},
        )
