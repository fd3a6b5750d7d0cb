"""One policy whose speed bound is an input, trained on a family of tasks through the rollout that every trainer uses.

    python benchmarks/dial.py [UPDATES] [SEED]

The bound of an episode is drawn log-uniformly from 0.2 to 1.6 m/s, and anew for a third of the episodes before each
update, so that it also changes in flight. The policy sees 21 numbers: the observation, log(bound / 0.6 m/s), and the
velocity over the bound. 3,000 updates take about five minutes on one core. Prints the response for eight bounds.
"""

import dataclasses
import math
import os
import sys
import time
from typing import Any

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import jax
import jax.numpy as jnp
import optax

from flytune import fly, judge, load_task
from flytune.config.pytree import pytree
from flytune.control.policy import make_network
from flytune.simulation.rollout import Draw, reset_all, rollout
from flytune.task.observation import NOISY, SIZE, input_scale
from flytune.training.update import averaged, descend

UPDATES, SEED = (int(text) for text in (sys.argv[1:] + ["3000", "0"][len(sys.argv) - 1 :])[:2])
ENVIRONMENTS, WINDOW, SLACK = 64, 400, 0.5
SLOWEST, FASTEST, BOUNDS = 0.2, 1.6, (0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.6)  # m/s
SCALE = input_scale((2.0, 3.0, 2.0, 0.4, 1.0))


def draw_bound(key, shape=()):
    """Speed bounds in m/s, log-uniform."""
    return jnp.exp(jax.random.uniform(key, shape, minval=math.log(SLOWEST), maxval=math.log(FASTEST)))


@pytree
class SpeedFamily:
    """A task whose speed bound is drawn for each episode; the reward of the velocity follows the bound."""

    task: Any

    def draw(self, key):
        """The bound of an episode, and the key of its initial state."""
        bound_key, key = jax.random.split(key)
        return draw_bound(bound_key), key

    def member(self, bound):
        """The task with this bound."""
        sharpness = 1.5 * jnp.maximum((bound / 0.8) ** -1.3, 0.7)
        changes = {
            "horizontal": {"weight": 0.25, "wide": 0.4, "narrow": 20.0},
            "vertical": {"wide": 1.0, "narrow": 60.0},
            "velocity": {"weight": 0.1, "sharpness": sharpness},
            "smoothness": {"weight": 0.05},
        }
        reward = {name: dataclasses.replace(term, **changes.get(name, {})) for name, term in self.task.reward.items()}
        speed = dataclasses.replace(self.task.termination["speed"], bound=bound)
        return dataclasses.replace(self.task, reward=reward, termination={**self.task.termination, "speed": speed})


def see(observation, bound):
    """What the network is given: [17] and a bound become [21]."""
    dial = jnp.log(bound / 0.6)[..., None]
    return jnp.concatenate([observation * SCALE, dial, observation[..., 7:10] / bound[..., None]], axis=-1)


@pytree
class DialPolicy:
    """A policy with its dial at a bound in m/s."""

    actor: Any
    bound: Any

    def initial_memory(self):
        """None."""
        return ()

    def act(self, memory, observation):
        """The action for one observation."""
        return memory, jnp.tanh(self.actor(see(observation, self.bound)))


base = load_task("inspection-refined")
family = SpeedFamily(task=dataclasses.replace(base, horizon=1500, initial_state=base.apg.initial_state))
rate = optax.cosine_decay_schedule(5e-3, UPDATES, 0.02)
optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate, b1=0.7, b2=0.95))


def worth(_, moved, outcome):
    """The reward of a step less the cost of the margins below 8 %."""
    weight = 40.0 * jnp.maximum(1.0, 0.8 / moved.numbers) ** 2
    weights = {name: weight if name == "speed" else 40.0 for name in outcome.margins}
    return outcome.reward - sum(
        weights[name] * jnp.maximum(0.08 - margin, 0.0) ** 2 for name, margin in outcome.margins.items()
    )


def loss(actor, episodes, key):
    """The mean cost of a step, and the episodes after the window."""
    noise_key, reset_key = jax.random.split(key)
    draws = Draw(
        noise=jax.random.normal(noise_key, (WINDOW, NOISY, ENVIRONMENTS)),
        keys=jax.random.split(reset_key, (WINDOW, ENVIRONMENTS)),
    )

    def decide(memory, observation, drawn, episodes):
        return memory, jnp.tanh(actor(see(observation, episodes.numbers))), ()

    (episodes, _), step = rollout(family, decide, (episodes, ()), draws, record=worth, slack=SLACK)
    return -jnp.mean(step.record), episodes


@jax.jit
def update(actor, moments, episodes, key):
    """One update, before which a third of the episodes gets another bound."""
    key, new_key, chosen_key = jax.random.split(key, 3)
    chosen = jax.random.uniform(chosen_key, (ENVIRONMENTS,)) < 1 / 3
    bounds = jnp.where(chosen, draw_bound(new_key, (ENVIRONMENTS,)), episodes.numbers)
    episodes = dataclasses.replace(episodes, numbers=bounds)
    (_, episodes), gradient = jax.value_and_grad(loss, has_aux=True)(actor, episodes, key)
    return *descend(optimiser, gradient, moments, actor), episodes


actor_key, episode_key, key = jax.random.split(jax.random.key(SEED), 3)
actor = ema = make_network(actor_key, (SIZE + 4, 64, 64, 4), last_gain=0.01)
moments = optimiser.init(actor)
episodes = reset_all(family, jax.random.split(episode_key, ENVIRONMENTS))
began = time.monotonic()
for number in range(UPDATES):
    actor, moments, episodes = update(actor, moments, episodes, jax.random.fold_in(key, number))
    ema = averaged(ema, actor, 0.95, jnp.asarray(number))
jax.block_until_ready(ema)
print(f"{UPDATES} updates, seed {SEED}: {time.monotonic() - began:.0f} s")
print("bound [m/s]  settled  settling [s]  error [mm]  peak speed, p95 [m/s]  over the bound  crashed")
for bound in BOUNDS:
    task = load_task("baseline", {"termination.speed.bound": bound})
    flights = fly(DialPolicy(actor=ema, bound=jnp.float32(bound)), task, duration=max(10.0, 6 / bound))
    judged = judge(flights).to_dict()
    position, speed = judged["position"], judged["peak_speed"]["p95"]
    settling, error = position["settling_time"]["median"], position["steady_state_error"]["median"]
    settling = "-" if settling is None else f"{settling:.2f}"
    print(
        f"{bound:11g}  {position['settled']:7}  {settling:>12}  {1e3 * error:10.1f}  {speed:21.3f}"
        f"  {judged['violations']['speed']:14}  {judged['crashed']:7}"
    )
