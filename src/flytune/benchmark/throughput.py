"""Throughput on this machine, and ratios of it, which are measured in one run and depend less on the machine."""

import dataclasses
import itertools
import os
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from flytune.benchmark import baselines
from flytune.benchmark.baselines import Measurement, fastest, repetitions
from flytune.benchmark.requirement import TimeToRequirement, time_to_requirement
from flytune.errors import BadInput
from flytune.simulation.environment import Episode
from flytune.simulation.rollout import Draw, reset_all, rollout
from flytune.task.files import load_task
from flytune.task.observation import SIZE
from flytune.task.task import Task
from flytune.task.training_settings import PpoSettings, TrainerSettings
from flytune.training.trainer import TRAINERS, Trainer

BATCH, WIDTH = 128, 64  # of the matrix product everything is compared with: 128 x 64 times 64 x 64, float32
SIMULATED = 1024, 200  # environments and steps of a compiled simulation
PARTS = ("all", "train", "simulate")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Throughput:
    """The result of a benchmark; rates in environment steps per second, None where not measured."""

    matrix_product: float  # floating-point operations per second
    ppo: float | None
    ppo_share_of_limit: float | None  # of what the matrix product alone would allow
    apg: float | None
    apg_share_of_limit: float | None
    simulate: float | None
    spread: dict[str, float]  # of each rate: how far the median of the repetitions lies below the best, as a share
    requirement: TimeToRequirement | None  # None where not measured
    training: list[Measurement] | None  # beside Stable-Baselines3 and PyBullet
    simulation: list[Measurement] | None
    device: str
    cores: int | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return dataclasses.asdict(self)

    def table(self) -> str:
        """The measurements for a terminal."""
        lines = [
            f"device {self.device}, {self.cores} cores, XLA_FLAGS={os.environ.get('XLA_FLAGS', '')!r}",
            f"{BATCH} x {WIDTH} x {WIDTH} float32 matrix product   {self.matrix_product / 1e9:8.1f} GFLOP/s",
        ]
        if self.ppo is not None and self.ppo_share_of_limit is not None:
            lines.append(
                f"train ppo (128 environments x 128 steps)   {self.ppo:10,.0f} steps/s   "
                f"{self.ppo_share_of_limit:.2f} of the product's limit"
            )
        if self.apg is not None and self.apg_share_of_limit is not None:
            lines.append(
                f"train apg (forward and backward)           {self.apg:10,.0f} steps/s   "
                f"{self.apg_share_of_limit:.2f} of the product's limit"
            )
        if self.simulate is not None:
            lines.append(f"simulate (observe, step, reward, reset)    {self.simulate:10,.0f} steps/s")
        lines += [f"the median of {what} is {share:.0%} below the best" for what, share in self.spread.items()]
        if self.requirement is not None:
            each = self.requirement
            warm = ", ".join(f"{seconds:.1f}" for seconds in each.warm)
            lines.append(
                f"train baseline, the whole command: cold {each.cold:.1f} s, warm {warm} s, {each.memory:,.0f} MiB, "
                f"requirement {'met' if each.met else 'not met'}"
            )
        for title, measurements in (("training", self.training), ("simulation", self.simulation)):
            if measurements is not None:
                heading = f"{title} (steps of each environment; ratio to the first row)"
                lines += ["", heading, str(baselines.measurements_table(measurements))]
        return "\n".join(lines)


def bench(what: str = "all") -> Throughput:
    """The throughput of training and of simulation, beside a matrix product, Stable-Baselines3 and PyBullet.

    `what` is `train`, `simulate` or `all`, which takes a few minutes. Packages that are not installed are left out and
    named.

    Raises:
        BadInput: `what` is something else.
    """
    if what not in PARTS:
        raise BadInput(f"what: {what!r} is not allowed. Allowed: {', '.join(PARTS)}.")
    task = load_task("baseline")
    training, simulation = what in ("all", "train"), what in ("all", "simulate")
    product = _matrix_product()
    ppo_update, fly = _training(TRAINERS["ppo"], task), _simulation(task)
    spread: dict[str, float] = {}

    def rate(what: str, steps: int, run: Callable[[], Any]) -> float:
        (seconds,) = repetitions([run])
        spread[what] = 1 - min(seconds) / statistics.median(seconds)
        return steps / min(seconds)

    ppo_rate = rate("ppo", task.ppo.steps_per_update, ppo_update) if training else None
    apg_rate = rate("apg", task.apg.steps_per_update, _training(TRAINERS["apg"], task)) if training else None
    simulated = rate("simulate", SIMULATED[0] * SIMULATED[1], fly) if simulation else None
    product = max(product, _matrix_product())  # the better of two, as other load disturbs it
    return Throughput(
        matrix_product=product,
        ppo=ppo_rate,
        ppo_share_of_limit=ppo_rate * operations_per_step(task.ppo) / product if ppo_rate else None,
        apg=apg_rate,
        apg_share_of_limit=apg_rate * 3 * operations_of_actor(task.apg) / product if apg_rate else None,
        simulate=simulated,
        spread=spread,
        requirement=time_to_requirement() if training else None,
        training=baselines.compare_training(task, ppo_update) if training else None,
        simulation=baselines.compare_simulation(task, fly, SIMULATED) if simulation else None,
        device=jax.devices()[0].platform,
        cores=os.cpu_count(),
    )


def operations_per_step(settings: PpoSettings) -> float:
    """Floating-point operations the networks of PPO need per environment step, products alone.

    Each epoch runs actor and critic forward and backward (3 times forward), the rollout runs the actor once and the
    critic twice (before and after the step); a multiplication and its addition count as two.
    """
    actor = operations_of_actor(settings)
    critic = actor - 2.0 * 3 * settings.hidden[-1]
    return 3 * settings.epochs * (actor + critic) + actor + 2 * critic


def operations_of_actor(settings: TrainerSettings) -> float:
    """Floating-point operations of one action, products alone; its gradient takes twice as many again."""
    return 2.0 * sum(fewer * more for fewer, more in itertools.pairwise((SIZE, *settings.hidden, 4)))


def _seconds(run: Callable[[], Any]) -> float:
    return fastest([run])[0]


def _matrix_product() -> float:
    first = jax.random.normal(jax.random.key(0), (BATCH, WIDTH))
    second = jax.random.normal(jax.random.key(1), (WIDTH, WIDTH)) / WIDTH**0.5
    number = 5000

    @jax.jit
    def chain(first: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda x, _: (x @ second, None), first, length=number)[0]

    return 2.0 * BATCH * WIDTH * WIDTH * number / _seconds(lambda: jax.block_until_ready(chain(first)))


def _training(trainer: Trainer, task: Task) -> Callable[[], Any]:
    """A function that makes one update of a training, and the next one at the next call."""
    train_state = None

    def one() -> Any:
        nonlocal train_state
        train_state = trainer.start(task, jax.random.key(0)) if train_state is None else train_state
        train_state, seen = trainer.update(task, train_state)
        return jax.block_until_ready(seen)

    return one


def _simulation(task: Task) -> Callable[[], Any]:
    """A flight of many episodes in one compiled call."""
    environments, steps = SIMULATED
    episodes = reset_all(task, jax.random.split(jax.random.key(0), environments))

    def decide(memory: Any, observation: jax.Array, draw: Any, episodes: Episode) -> Any:
        return memory, 0.1 * observation[:, :4], ()

    @jax.jit
    def fly(episodes: Episode, key: jax.Array) -> Any:
        noise_key, reset_key = jax.random.split(key)
        draws = Draw(
            noise=jax.random.split(noise_key, (steps, environments)),
            keys=jax.random.split(reset_key, (steps, environments)),
        )
        record = rollout(
            task, decide, (episodes, ()), draws, record=lambda task, after, moved, outcome: outcome.reward
        )[1]
        return record.record.mean()

    return lambda: jax.block_until_ready(fly(episodes, jnp.asarray(jax.random.key(1))))
