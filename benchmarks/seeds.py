"""Several seeds of PPO on one core: one after the other, or as one program over a batch of seeds.

    python benchmarks/seeds.py

Prints environment steps per second on one core for both, timed in turns in one run. Where the batch is no faster,
processes side by side are the better use of several cores (`flytune reproduce`).
"""

import os
import time
from functools import partial

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
os.environ["FLYTUNE_CORES"] = "1"

import jax

from flytune.task.files import load_task
from flytune.training import ppo

SEEDS, REPEATS = 5, 4

task = load_task("baseline")
samples = task.ppo.environments * task.ppo.rollout
alone = partial(ppo.update, task, task.ppo)
together = jax.jit(jax.vmap(alone), donate_argnums=0)
keys = jax.random.split(jax.random.key(0), SEEDS)
train_states = {
    "one seed": ppo.start(task, task.ppo, keys[0]),
    f"{SEEDS} seeds in one program": jax.vmap(partial(ppo.start, task, task.ppo))(keys),
}
updates = {"one seed": (alone, 1), f"{SEEDS} seeds in one program": (together, SEEDS)}
best = dict.fromkeys(train_states, float("inf"))
for turn in range(REPEATS + 1):
    for name, (update, number) in updates.items():
        started = time.perf_counter()
        train_states[name], seen = update(train_states[name])
        jax.block_until_ready(seen)
        if turn:  # the first compiles
            best[name] = min(best[name], (time.perf_counter() - started) / number)
for name, seconds in best.items():
    print(f"{name:<28} {samples / seconds:10,.0f} steps/s")
one, many = best.values()
print(f"ratio {one / many:.2f}")
