"""The response map of a policy with a dial: what response each setting gives, and which setting gives a response."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flytune.errors import BadInput
from flytune.tables import Column, Table, number

COLUMNS = (
    Column("settled", lambda row: row["settled"]),
    Column("median", lambda row: row["time"]["median"], group="settling time [s]", decimals=2),
    Column("95 % interval", lambda row: _between(row["time"]), group="settling time [s]"),
    Column("overshoot p90 [%]", lambda row: row["overshoot"], decimals=1, scale=100.0),
    Column("error [mm]", lambda row: row["error"]["median"], decimals=1, scale=1e3),
    Column("median", lambda row: row["speed"]["median"], group="peak speed [m/s]", decimals=2),
    Column("p95", lambda row: row["speed"]["p95"], group="peak speed [m/s]", decimals=2),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResponseMap:
    """The measured response along one dial, all other dials at their defaults. Every list has one entry per setting."""

    dial: str
    unit: str
    trials: int  # per setting
    seed: int
    values: list[float]  # of the dial, rising
    settled: list[int]  # trials whose position settled
    settling_time: list[dict[str, float | None]]  # of the position, s: median, and its 95 % interval low, high
    overshoot: list[float | None]  # of the position, 90th percentile, share of the step
    steady_state_error: list[dict[str, float | None]]  # of the position, m: median, low, high
    peak_speed: list[dict[str, float | None]]  # m/s: median, p95
    monotone: list[float | None]  # s, the settling times made monotone; None where too few trials settle

    def table(self) -> str:
        """The map for a terminal: one row per setting."""
        unit = f" [{self.unit}]" if self.unit else ""
        rows = [
            {
                "value": value, "settled": f"{settled}/{self.trials}", "time": time, "overshoot": overshoot,
                "error": error, "speed": speed,
            }
            for value, settled, time, overshoot, error, speed in zip(
                self.values, self.settled, self.settling_time, self.overshoot, self.steady_state_error,
                self.peak_speed, strict=True,
            )
        ]  # fmt: skip
        columns = [Column(f"{self.dial}{unit}", lambda row: row["value"], decimals=3), *COLUMNS]
        return Table.of(columns, rows).text()

    def setting_for(self, settling_time: float) -> float:
        """The value of the dial whose median settling time is nearest to the one wanted in s, by the monotone curve.

        Between two settings, the curve is a line in the logarithms of value and time; of a dial with values of 0 or
        less, in the value and the logarithm of time.
        """
        values, times = self._curve()
        distinct, group = np.unique(times, return_inverse=True)  # settings of one time give their mean
        means = np.bincount(group, values) / np.bincount(group)
        found = np.interp(np.log(settling_time), distinct, means)
        return float(np.exp(found) if self._positive else found)

    def slope(self) -> float:
        """d log(settling time) / d log(value), over the whole range."""
        values, times = self._curve()
        return float((times[-1] - times[0]) / (values[-1] - values[0]))

    def range(self) -> tuple[float, float]:
        """The shortest and the longest settling time of the curve in s."""
        _, times = self._curve()
        return float(np.exp(times.min())), float(np.exp(times.max()))

    def covers(self, settling_time: float) -> bool:
        """Whether the settling time in s lies between the shortest and the longest of the curve, up to rounding."""
        fastest, slowest = self.range()
        return 0.999 * fastest <= settling_time <= 1.001 * slowest

    @property
    def _positive(self) -> bool:
        return min(self.values) > 0

    def _curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Value, as a logarithm where it has one, and logarithm of the settling time of all settings that settle."""
        known = [(value, time) for value, time in zip(self.values, self.monotone, strict=True) if time is not None]
        if len(known) < 2:
            raise BadInput(
                f"dial {self.dial}: fewer than two settings settle. Set the dial itself, CONTROLLER@{self.dial}=VALUE, "
                "or train longer: `flytune train TASK --from CONTROLLER`."
            )
        values, times = np.asarray(known, float).T
        return np.log(values) if self._positive else values, np.log(times)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for the header of a policy's file."""
        return dataclasses.asdict(self)

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> "ResponseMap":
        """The map of a policy's header.

        Raises:
            BadInput: it is not a map.
        """
        try:
            found = cls(**{**data, "values": [float(value) for value in data["values"]]})
            found.table()
            if any(time is not None for time in found.monotone):
                np.log(np.asarray([time for time in found.monotone if time is not None], float))
            return found
        except (TypeError, ValueError, AttributeError, KeyError):
            raise BadInput(
                "map: the response map of the policy is damaged. Set the dial itself, or measure the map: "
                "`flytune map CONTROLLER --measure 11`."
            ) from None


def response_map(policy: Any, dial: str | None = None) -> ResponseMap | None:
    """The response map that a policy carries along a dial, the first one where None; None where it carries none."""
    maps = getattr(policy, "maps", {})  # the file of another program has none
    name = dial or next(iter(maps), "")
    return ResponseMap.read(maps[name]) if name in maps else None


def monotone(times: Sequence[float | None]) -> list[float | None]:
    """The times made monotone by the pool-adjacent-violators algorithm on their logarithms; None stays.

    Whether they rise or fall is decided by the first and the last.

    Source: Barlow et al., Statistical inference under order restrictions (1972).
    """
    known = {index: time for index, time in enumerate(times) if time is not None}
    if len(known) < 2:
        return list(times)
    logarithms = np.log(list(known.values()))
    sign = 1.0 if logarithms[-1] >= logarithms[0] else -1.0
    pools: list[tuple[float, int]] = []  # mean and size
    for value in sign * logarithms:
        pools.append((float(value), 1))
        while len(pools) > 1 and pools[-2][0] > pools[-1][0]:
            (first, n), (second, m) = pools[-2:]
            pools[-2:] = [((first * n + second * m) / (n + m), n + m)]
    smooth = np.exp(sign * np.concatenate([np.full(size, mean) for mean, size in pools]))
    result = list(times)
    for index, value in zip(known, smooth, strict=True):
        result[index] = float(value)
    return result


def _between(time: Mapping[str, float | None]) -> str:
    return f"{number(time['low'], 2)} to {number(time['high'], 2)}"
