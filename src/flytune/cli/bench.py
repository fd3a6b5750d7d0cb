"""`flytune bench`."""

import json
from typing import Annotated, Literal

from cyclopts import Parameter

from flytune.cli.options import AsJson

What = Annotated[Literal["all", "train", "simulate"], Parameter(name="WHAT", help="what to measure")]


def bench(what: What = "all", /, *, as_json: AsJson = False) -> None:
    """Measure the throughput on this machine, beside that of other packages that are installed."""
    from flytune.benchmark.throughput import bench

    result = bench(what)
    print(json.dumps(result.to_dict()) if as_json else result.table())
