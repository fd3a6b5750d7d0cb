"""`flytune map`."""

import json
from typing import Annotated

from cyclopts import Parameter

from flytune.cli.options import AsJson, Controller, Whole
from flytune.errors import BadInput


def map(
    controller: Controller,
    /,
    *,
    dial: Annotated[str | None, Parameter(help="the dial (default: the first one of the policy)")] = None,
    measure: Annotated[
        Whole | None,
        Parameter(metavar="N", help="measure the map now at N settings (default: the map that the policy carries)"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the response that each setting of a policy's dial gives."""
    from flytune.control.response_map import response_map
    from flytune.evaluation.measure_map import SETTINGS, measure_map
    from flytune.runs.find import find_controller, split_setting

    found = find_controller(split_setting(controller)[0])  # the map is that of all settings
    policy = found.controller
    if not getattr(policy, "dials", {}):
        raise BadInput(f"{controller}: has no dial. Allowed: a policy with dials, for instance dial.")
    if measure is not None and not 2 <= measure <= 1000:
        raise BadInput(f"measure: {measure} is not allowed. Allowed: a whole number, 2 to 1000.")
    known = response_map(policy, dial) if measure is None else None
    shown = known or measure_map(policy, found.task, dial, settings=measure or SETTINGS)
    print(json.dumps({"schema": 1, "who": controller, **shown.to_dict()}) if as_json else shown.table())
