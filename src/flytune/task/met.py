"""What a controller meets: a task in which the true vehicle or its sensors differ from what the controller was told."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from flytune.errors import BadInput
from flytune.physics.vehicle import TrueVehicle
from flytune.task.files import edited_task
from flytune.task.task import Task

PARTS = ("vehicle", "noise")  # of a task that may differ
# of the vehicle, what belongs to the interface of a controller
INTERFACE = ("action_convention", "action_scale", "control_rate", "nominal")


def as_met(task: Task, changes: Mapping[str, Any]) -> Task:
    """The task that is flown where the truth differs from it.

    The controller was made for `task`. Its actions ask for the rotor speeds that they would mean on the vehicle of
    `task`, whatever the true vehicle weighs; the rotors of the true one turn no faster or slower than they can.

    Args:
        task: a task without dials, as the controller was told.
        changes: field path -> its true value; `vehicle` takes a name or a file.

    Raises:
        BadInput: a field that is not met in flight or belongs to the controller, or a value that is not allowed.
    """
    for path in changes:
        part, _, field = path.partition(".")
        if part not in PARTS:
            raise BadInput(
                f"set: {path} is not what a controller meets in flight. Allowed: fields of {', '.join(PARTS)}. To fly "
                "another task, known to the controller, give --task."
            )
        if part == "vehicle" and field in INTERFACE:
            raise BadInput(
                f"set: {path} says what an action of the controller means, and is no property of the vehicle that it "
                "meets. Give a task with it, --task."
            )
    if not changes:
        return task
    met = edited_task(task, changes)
    if met.vehicle.control_rate != task.vehicle.control_rate:
        raise BadInput(
            f"set: vehicle: {met.vehicle.name} is controlled at {met.vehicle.control_rate} Hz, and the controller acts "
            f"at {task.vehicle.control_rate} Hz. Give a vehicle with the same control_rate."
        )
    fields = {field.name: getattr(met.vehicle, field.name) for field in dataclasses.fields(met.vehicle)}
    return dataclasses.replace(met, vehicle=TrueVehicle(**fields, nominal=task.vehicle))
