"""`flytune vehicle`."""

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from flytune.cli.completion import completed_by, vehicles
from flytune.cli.options import AsJson
from flytune.errors import BadInput

if TYPE_CHECKING:
    from flytune.physics.found_vehicle import FoundVehicle

Source = Annotated[
    str,
    Parameter(
        name="VEHICLE",
        help="a vehicle that ships, its own file (.toml), or the file of another program: .urdf as in "
        "gym-pybullet-drones or with the motor models of Gazebo, .sdf of Gazebo and PX4, .xml of MuJoCo",
    ),
    completed_by(vehicles),
]
Out = Annotated[Path | None, Parameter(name="--out", metavar="FILE.toml", help="write the vehicle to this file")]


def vehicle(source: Source, /, *, out: Out = None, as_json: AsJson = False) -> None:
    """Print a vehicle as TOML: each number with its unit and source, derived figures, and what is missing."""
    from flytune.config.files import check_file, write_text
    from flytune.physics.found_vehicle import MARK, completed, text

    if out is not None:
        if out.suffix != ".toml":
            raise BadInput(f"out: {out} is not allowed. Allowed: a name that ends in .toml, as vehicle files have.")
        check_file(out, mark=MARK.encode(), kind="a vehicle file")
    found = completed(_find(source))
    content = text(found)
    if out is not None:
        write_text(out, content)
    print(json.dumps(_as_json(found)) if as_json else str(out) if out is not None else content, end="")
    if as_json or out is not None:
        print()
    for name, how in found.missing.items():
        print(f"missing: {name}: {how}", file=sys.stderr)


def _find(source: str) -> "FoundVehicle":
    """What the file, or the vehicle that ships, tells."""
    from flytune.physics.found_vehicle import from_table
    from flytune.physics.vehicle import vehicle_table
    from flytune.simulation.reading import SUFFIXES, read_model

    if source.lower().endswith(SUFFIXES):
        return read_model(Path(source).expanduser())
    if not source.endswith(".toml") and os.path.isfile(source):
        raise BadInput(f"vehicle: {source} is not allowed. Allowed: a file .toml, .urdf, .sdf or .xml, or a name.")
    return from_table(vehicle_table(source))


def _as_json(found: "FoundVehicle") -> dict[str, Any]:
    return {
        "schema": 1,
        "name": found.name,
        "vehicle": found.table,
        "units": found.units,
        "sources": found.sources,
        "figures": [
            {"name": each.name, "value": each.value, "unit": each.unit.strip(), "usual": list(each.usual)}
            for each in found.figures()
        ],
        "missing": found.missing,
        "assumed": found.assumed,
        "notes": list(found.notes),
    }
