"""TensorBoard: the rows of metrics.jsonl as event files beside it, written while a training runs."""

import contextlib
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from flytune.config.nested import leaves
from flytune.errors import require


class EventLog(contextlib.AbstractContextManager["EventLog"]):
    """An event file in a run directory; one scalar per number of a row, over environment steps.

    A resumed run starts another file, which makes TensorBoard forget the files before it and repeats the rows of the
    checkpoint: no row is seen twice, and none that came after the checkpoint and was trained again.
    """

    def __init__(self, directory: Path, rows: Sequence[dict[str, Any]] = ()) -> None:
        """Start a file with the rows so far.

        Raises:
            BadInput: the extra `tensorboard` is not installed.
        """
        require("tensorboard", "tensorboard")
        self._events: Any = require("tensorboard.compat.proto.event_pb2", "tensorboard")
        records = require("tensorboard.summary.writer.record_writer", "tensorboard")
        number = len(list(directory.glob("events.out.tfevents.*"))) + 1
        # TensorBoard knows its files by the name and reads them in its order
        self._file = open(directory / f"events.out.tfevents.{number:04d}", "xb")  # noqa: SIM115  (closed by `close`)
        self._records = records.RecordWriter(self._file)
        self._began = time.time() - (rows[-1]["seconds"] if rows else 0.0)
        self._add(self._events.Event(wall_time=time.time(), file_version="brain.Event:2"))
        start = self._events.SessionLog(status=self._events.SessionLog.START)
        self._add(self._events.Event(wall_time=time.time(), step=0, session_log=start))
        for row in rows:
            self.write(row)

    def write(self, row: dict[str, Any]) -> None:
        """Add a row of the metrics, so that a TensorBoard that is watching sees it now."""
        event = self._events.Event(wall_time=self._began + row["seconds"], step=row["steps"])
        for name, value in scalars(row):
            event.summary.value.add(tag=name, simple_value=value)
        self._add(event)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add(self, event: Any) -> None:
        self._records.write(event.SerializeToString())


def scalars(row: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Name and value of each finite number of a row, without the steps; `terms/attitude` for one in a table."""
    for name, value in leaves(row, separator="/"):
        if isinstance(value, int | float) and math.isfinite(value) and name != "steps":
            yield name, float(value)
