"""Trainers: the ways to learn a policy, and the one list of them.

A new trainer is a module and one entry of `TRAINERS`. This module imports no JAX, so that the command line names the
trainers without waiting for it.
"""

from __future__ import annotations

import dataclasses
import json
from importlib import import_module
from typing import TYPE_CHECKING, Any

from flytune.errors import BadInput, require
from flytune.runs.shipped import DEFAULT_TRAINER as DEFAULT_TRAINER

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jax import Array

    from flytune.control.policy import Policy
    from flytune.task.task import Task
    from flytune.task.training_settings import TrainerSettings
    from flytune.training.warm_start import Critic


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trainer:
    """A way to learn a policy.

    Its module offers the pure functions `start(task, settings, key)`, `update(task, settings, train_state)`,
    `policy(settings, train_state)`, `last_policy(settings, train_state)`, and where it is supported
    `warm_start(settings, train_state, policy, critic)`. The training state is a JAX pytree of the module's own.
    """

    name: str
    summary: str  # one line for help texts
    module: str
    settings_field: str  # the field of the task that holds the settings, see `TrainerSettings`
    extra: str = ""  # the extra of flytune that brings `packages`
    packages: tuple[str, ...] = ()  # optional packages that the trainer needs; run.json records their versions
    missing_settings: tuple[str, ...] = ()  # that the trainer lacks, which must therefore have their default values
    own_starts: bool = False  # whether its settings, not the task, say where training episodes begin
    supports_dials: bool = False  # whether it can train a task with dials
    supports_warm_start: bool = False  # whether a training can start from the weights of a policy
    tuning_goes_on: bool = False  # whether each training of a tuning starts from the policy before

    def settings(self, task: Task) -> TrainerSettings:
        """The settings of this trainer in a task."""
        return getattr(task, self.settings_field)

    def settings_at_rate(self, task: Task) -> TrainerSettings:
        """The settings at the control rate of the vehicle: what counts steps of 0.01 s then counts control steps."""
        return self.settings(task).at_rate(task.vehicle.control_rate)

    def with_steps(self, task: Task, steps: int) -> Task:
        """The task with a training of about `steps` environment steps, rounded up to whole updates.

        Raises:
            BadInput: no step.
        """
        if steps < 1:
            raise BadInput(f"steps: {steps} is not allowed. Allowed: a whole number, 1 or more environment steps.")
        changed: Any = {self.settings_field: self.settings(task).with_steps(steps)}
        return dataclasses.replace(task, **changed)

    def check(self, task: Task) -> None:
        """Refuse a task that this trainer cannot train here, before anything is written.

        Raises:
            BadInput: a package is not installed, the trainer lacks a setting that the task uses, or every episode would
                end as it begins.
        """
        import numpy as np

        from flytune.task.agreement import check_starts

        for package in self.packages:
            require(package, self.extra)
        if task.dial and not self.supports_dials:
            able = ", ".join(each.name for each in TRAINERS.values() if each.supports_dials)
            raise BadInput(
                f"dial: a task with dials is not allowed with trainer {self.name}. Allowed: trainer {able}; or the "
                "task at one setting, for instance from Python: task.at({...})."
            )
        settings = self.settings(task)
        for name in self.missing_settings:
            value, default = (np.asarray(getattr(each, name)).tolist() for each in (settings, type(settings)()))
            if value != default:
                raise BadInput(
                    f"{self.settings_field}.{name}: {json.dumps(value)} is not allowed with trainer {self.name}, which "
                    f"has no such setting. Allowed: {json.dumps(default)}. Give this value, or another trainer."
                )
        if self.own_starts:
            own: Any = settings
            check_starts(task, own.initial_state, f"{self.settings_field}.initial_state", float(own.termination_slack))
        else:
            check_starts(task)

    def check_edits(self, paths: Iterable[str]) -> None:
        """Refuse edits of a task that this trainer does not read, so that they would change nothing.

        Raises:
            BadInput: the path of such an edit, and what the trainer reads instead.
        """
        others: dict[str, str] = {}
        for each in TRAINERS.values():
            others.setdefault(each.settings_field, each.name)
        for path in paths:
            part, _, rest = path.partition(".")
            if part in others and part != self.settings_field:
                raise BadInput(
                    f"set: {path} is not read by trainer {self.name}, which has its settings in {self.settings_field}. "
                    f"Set a field of {self.settings_field}, or give --trainer {others[part]}."
                )
            if part == "initial_state" and self.own_starts:
                instead = ".".join(filter(None, (self.settings_field, part, rest)))
                raise BadInput(
                    f"set: {path} is not read by trainer {self.name}, whose episodes begin in "
                    f"{self.settings_field}.initial_state. Set {instead}."
                )

    def start(self, task: Task, key: Array) -> Any:
        """The training state before the first update."""
        from flytune.training.threads import keep_freed_memory

        keep_freed_memory()
        return self._algorithm().start(task, self.settings_at_rate(task), key)

    def update(self, task: Task, train_state: Any) -> tuple[Any, dict[str, Any]]:
        """The training state after one update, and its metrics: `rollout_metrics` and the losses.

        The state before may not be used again.
        """
        return self._algorithm().update(task, self.settings_at_rate(task), train_state)

    def policy(self, task: Task, train_state: Any) -> Policy:
        """The policy of the training: for PPO, of the moving average of the weights."""
        return _completed(self._algorithm().policy(self.settings_at_rate(task), train_state), task)

    def last_policy(self, task: Task, train_state: Any) -> Policy:
        """The policy of the last update."""
        return _completed(self._algorithm().last_policy(self.settings_at_rate(task), train_state), task)

    def warm_start(self, task: Task, train_state: Any, policy: Policy, critic: Critic | None = None) -> Any:
        """The training state before the first update, with an actor that gives the actions of `policy`.

        A trainer with a critic starts from `critic`, or from new weights where that is None.

        Raises:
            BadInput: see `check_warm_start`.
        """
        self.check_warm_start(task, policy)
        return self._algorithm().warm_start(self.settings_at_rate(task), train_state, policy, critic)

    def check_warm_start(self, task: Task, policy: Policy, field: str = "warm_start") -> None:
        """Refuse a warm start that is not possible, before anything is written.

        Raises:
            BadInput: the trainer has no warm start, or the policy has other inputs, layers, squash or bounds.
        """
        from flytune.config import document

        if not self.supports_warm_start:
            able = ", ".join(trainer_names(warm_start=True))
            raise BadInput(f"{field}: trainer {self.name} cannot start from a policy. Allowed: trainer {able}.")
        inputs, wanted = (
            {name: document.plain(each) for name, each in given.items()} for given in (policy.inputs, task.input)
        )
        if inputs != wanted:
            remedy = "Give the policy at a setting, NAME@DIAL=VALUE." if policy.dials and not task.dial else (
                "Give a policy that was trained on a task with the same [input]."
            )  # fmt: skip
            raise BadInput(
                f"{field}: a policy with the inputs {', '.join(inputs) or 'none'} beside the observation is not "
                f"allowed. Allowed: those of the task ({', '.join(wanted) or 'none'}). {remedy}"
            )
        if policy.bounds is not None:
            raise BadInput(
                f"{field}: a policy that clips its observations, as one that was trained behind VecNormalize, is not "
                "allowed. Allowed: a policy of the observations as they are."
            )
        own = self._shape(task)
        given, allowed = ([weight.shape for weight in each.actor.weights] for each in (policy, own))
        if (given, policy.squash) == (allowed, own.squash):
            return
        if given != allowed:
            hidden = [shape[1] for shape in given[:-1]]
            remedy = f"Add --set '{self.settings_field}.hidden={hidden}'."
        else:
            able = [each.name for each in TRAINERS.values() if each.supports_warm_start]
            fits = [name for name in able if TRAINERS[name]._shape(task).squash == policy.squash]
            remedy = f"Add --trainer {' or '.join(fits)}."
        raise BadInput(
            f"{field}: a policy with layers {given} and squash {policy.squash} is not allowed. "
            f"Allowed: layers {allowed} and squash {own.squash}, as trainer {self.name} makes them for this task. "
            f"{remedy}"
        )

    def _shape(self, task: Task) -> Policy:
        """The shapes of the policies that this trainer makes for a task."""
        import jax

        return jax.eval_shape(lambda key: self.policy(task, self.start(task, key)), jax.random.key(0))

    def _algorithm(self) -> Any:
        return import_module(self.module)


def _completed(policy: Policy, task: Task) -> Policy:
    """The policy with the dials of its task at their defaults, and with the longest position error it has to know.

    That is the distance of the farthest start, of the training or of an evaluation.
    """
    import jax

    from flytune.task.initial_state import EVALUATION_INITIAL_STATES
    from flytune.task.situation import POSITION_BAND

    setting = {name: float(dial.default) for name, dial in task.dial.items()}
    with jax.ensure_compile_time_eval():  # also where only the shapes of a policy are asked for
        farthest = max(float(each.farthest()) for each in (task.initial_state, *EVALUATION_INITIAL_STATES.values()))
    return dataclasses.replace(
        policy,
        dials=task.dial,
        inputs=task.input,
        setting=setting,
        error_limit=round(farthest + POSITION_BAND, 3),
    )


TRAINERS = {
    trainer.name: trainer
    for trainer in (
        Trainer(
            name="apg",
            summary="analytic policy gradient, through the differentiable simulator",
            module="flytune.training.apg",
            settings_field="apg",
            own_starts=True,
            supports_dials=True,
            supports_warm_start=True,
            tuning_goes_on=True,
        ),
        Trainer(
            name="ppo",
            summary="proximal policy optimisation, the algorithm of the paper",
            module="flytune.training.ppo",
            settings_field="ppo",
            supports_dials=True,
            supports_warm_start=True,
        ),
        Trainer(
            name="sb3",
            summary="the PPO of Stable-Baselines3, the software of the paper, with the settings of ppo",
            module="flytune.training.sb3",
            settings_field="ppo",
            extra="sb3",
            packages=("gymnasium", "torch", "stable_baselines3"),
            missing_settings=("separate_grad_clipping", "final_learning_rate", "input_scale"),
        ),
    )
}


def trainer_names(
    *, every_task: bool = False, warm_start: bool = False, tuning_goes_on: bool = False
) -> tuple[str, ...]:
    """The names of all trainers, or of those that can train every task, support a warm start, or use it in tuning."""
    return tuple(
        name
        for name, trainer in TRAINERS.items()
        if not (every_task and trainer.missing_settings)
        and (trainer.supports_warm_start or not warm_start)
        and (trainer.tuning_goes_on or not tuning_goes_on)
    )


def other_settings_fields(name: str) -> set[str]:
    """The fields of a task that hold settings of trainers, without that of one trainer."""
    return {trainer.settings_field for trainer in TRAINERS.values()} - {TRAINERS[name].settings_field}


def find_trainer(name: str, *, every_task: bool = False) -> Trainer:
    """The trainer of a name.

    Raises:
        BadInput: there is none, it cannot train every task where that is needed, or `FLYTUNE_CORES` is not a number.
    """
    from flytune.training.threads import cores

    cores()  # refused here, before anything is written
    names = trainer_names(every_task=every_task)
    if name not in names:
        raise BadInput(f"trainer: {name!r} is not allowed. Allowed: {', '.join(names)}.")
    return TRAINERS[name]
