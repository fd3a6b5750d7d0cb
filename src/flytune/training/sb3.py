"""The software of the paper (R17): Stable-Baselines3's PPO, unchanged, on flytune's environments.

The training state is a pytree of plain arrays. For one update it is loaded into Stable-Baselines3's model and the
environments, and read from them afterwards. So a checkpoint is complete, and a resumed training is the same bit by bit.
"""

# pyright: reportMissingImports=false
# PyTorch is in no pinned requirement; without it the rest is checked all the same

import contextlib
import dataclasses
import random
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from flytune.config.pytree import pytree, static
from flytune.control.policy import Network, Policy
from flytune.errors import Diverged
from flytune.export.untrusted.sb3_model import actor_network
from flytune.task.observation import SIZE
from flytune.task.task import Task
from flytune.task.training_settings import PpoSettings
from flytune.training.update import averaged, rollout_metrics

LOSSES = {  # our names -> those in the log of Stable-Baselines3
    "loss": "train/loss",
    "policy_loss": "train/policy_gradient_loss",
    "value_loss": "train/value_loss",
    "clip_fraction": "train/clip_fraction",
    "approximate_kl": "train/approx_kl",
    "explained_variance": "train/explained_variance",
    "std": "train/std",
}

# parts of the errors that numbers which are not finite cause in torch's Gaussian, in Adam, in flytune's environments
DIVERGENCE = ("Expected parameter", "overflow", "not finite")


@pytree
class TrainState:
    """Everything an update needs and changes."""

    model: Any = static()  # the `_Model` that updates it; its content is replaced at each update
    weights: dict[str, Any]  # of actor, critic and standard deviation, by torch's names
    first_moments: dict[str, Any]  # Adam's, by the same names
    second_moments: dict[str, Any]
    ema: Network  # exponential moving average of the actor over updates
    episodes: Any  # [K, N] as `HostEnvironment` keeps them
    key: Any  # raw, of initial states and noise
    observation: Any  # [N, 17] last seen
    torch_random: Any  # the state of torch's generator: actions
    numpy_random: Any  # the state of NumPy's: minibatches
    minibatches: Array  # Adam's steps
    updates: Array


def policy(settings: PpoSettings, train_state: TrainState) -> Policy:
    """The policy of the averaged actor: its mean action."""
    return Policy(actor=train_state.ema, input_scale=jnp.ones(SIZE), squash="clip")


def last_policy(settings: PpoSettings, train_state: TrainState) -> Policy:
    """The policy of the last update, the paper's as printed."""
    return Policy(actor=actor_network(train_state.weights), input_scale=jnp.ones(SIZE), squash="clip")


def start(task: Task, settings: PpoSettings, key: jax.Array) -> TrainState:
    """The training state before the first update."""
    with _restored_generators():
        model = _Model(task, settings, int(jax.random.bits(key)))
        fields = model.read()
    return TrainState(model=model, ema=actor_network(fields["weights"]), updates=jnp.zeros((), jnp.int32), **fields)


def update(task: Task, settings: PpoSettings, train_state: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """The training state after one update, and its metrics."""
    with _restored_generators():
        train_state.model.load(train_state)
        metrics = train_state.model.update(train_state)
        fields = train_state.model.read()
    ema = averaged(train_state.ema, actor_network(fields["weights"]), settings.ema_decay, train_state.updates)
    return TrainState(model=train_state.model, ema=ema, updates=train_state.updates + 1, **fields), metrics


def make_model(settings: PpoSettings, environments: Any, seed: int) -> Any:
    """Stable-Baselines3's PPO with our settings, on a vector environment of its kind."""
    from stable_baselines3 import PPO
    from torch.nn import Tanh

    hidden = list(settings.hidden)
    return PPO(
        "MlpPolicy",
        environments,
        n_steps=settings.rollout,
        n_epochs=settings.epochs,
        batch_size=settings.minibatch,
        learning_rate=float(settings.learning_rate),
        clip_range=float(settings.clip_range),
        gamma=float(settings.discount),
        gae_lambda=float(settings.gae_lambda),
        vf_coef=float(settings.value_weight),
        ent_coef=float(settings.entropy_weight),
        max_grad_norm=float(settings.max_grad_norm),
        policy_kwargs={
            "net_arch": {"pi": hidden, "vf": hidden},
            "activation_fn": Tanh,
            "log_std_init": float(settings.initial_log_std),
        },
        seed=seed,
        device="cpu",
    )


class _Model:
    """Stable-Baselines3's model, and the environments that it learns in."""

    def __init__(self, task: Task, settings: PpoSettings, seed: int) -> None:
        from flytune.adapters.vec_env import HoverVecEnv

        self.task, self.settings = task, settings
        self.environments = HoverVecEnv(task, settings.environments, seed)
        self.model = make_model(settings, self.environments, seed)

    def load(self, train_state: TrainState) -> None:
        """Set model, environments and random numbers to a training state."""
        import torch

        def tensor(values: Any) -> torch.Tensor:
            return torch.from_numpy(np.array(values))

        network = self.model.policy
        network.load_state_dict({name: tensor(values) for name, values in train_state.weights.items()})
        memory = {
            index: {
                "step": tensor(np.float32(train_state.minibatches)),
                "exp_avg": tensor(train_state.first_moments[name]),
                "exp_avg_sq": tensor(train_state.second_moments[name]),
            }
            for index, (name, _) in enumerate(network.named_parameters())
        }
        network.optimizer.load_state_dict({**network.optimizer.state_dict(), "state": memory})
        environment = self.environments.environment
        # copies, because the compiled step reuses their memory
        environment.episodes = jnp.array(train_state.episodes)
        environment.key = jax.random.wrap_key_data(jnp.array(train_state.key))
        environment.observation = np.array(train_state.observation)
        numbers = np.array(train_state.numpy_random)
        # the global generator, because Stable-Baselines3 draws from it
        np.random.set_state(  # noqa: NPY002
            {"bit_generator": "MT19937", "state": {"key": numbers[:-1], "pos": int(numbers[-1])}}
        )
        torch.set_rng_state(tensor(train_state.torch_random))

    def read(self) -> dict[str, Any]:
        """Copies of model, environments and random numbers: most fields of the training state."""
        import torch

        network, environment = self.model.policy, self.environments.environment
        memory = network.optimizer.state  # empty before the first step, when the moments are zero
        named = list(network.named_parameters())

        def moments(kind: str) -> dict[str, np.ndarray]:
            return {
                name: memory[weight][kind].numpy().copy() if weight in memory else np.zeros(weight.shape, np.float32)
                for name, weight in named
            }

        steps = {int(memory[weight]["step"]) for _, weight in named if weight in memory}
        state = np.random.get_state(legacy=False)["state"]  # noqa: NPY002
        return {
            "weights": {name: weight.detach().numpy().copy() for name, weight in named},
            "first_moments": moments("exp_avg"),
            "second_moments": moments("exp_avg_sq"),
            "episodes": np.array(environment.episodes),
            "key": np.array(jax.random.key_data(environment.key)),
            "observation": environment.observation.copy(),
            "torch_random": torch.get_rng_state().numpy().copy(),
            "numpy_random": np.append(state["key"], np.uint32(state["pos"])),
            "minibatches": jnp.asarray(max(steps, default=0), jnp.int32),
        }

    def update(self, train_state: TrainState) -> dict[str, Any]:
        """The metrics of one rollout and its epochs.

        Raises:
            Diverged: the weights stopped being finite.
        """
        from stable_baselines3.common.callbacks import BaseCallback

        environments, transitions = self.environments, []

        class Watch(BaseCallback):
            def _on_step(self) -> bool:
                transitions.append(environments.transition)
                return True

        self.model._last_obs = environments.environment.observation
        # whether an episode starts with the rollout; flytune does not use it, and any value gives the same training
        self.model._last_episode_starts = np.ones(self.settings.environments, bool)
        samples = self.settings.environments * self.settings.rollout
        try:
            # one rollout and its epochs; Stable-Baselines3 would print from the second on
            self.model.learn(samples, Watch(), log_interval=2, reset_num_timesteps=False)
        except (ValueError, RuntimeError) as error:
            if not any(words in str(error) for words in DIVERGENCE):
                raise
            number = int(train_state.updates) + 1
            raise Diverged(
                f"training: the weights stop being finite in update {number} ({number * samples} environment steps). "
                "A smaller learning rate (--set ppo.learning_rate=VALUE), or smaller weights in the reward, may help."
            ) from None
        logged = self.model.logger.name_to_value
        steps = dataclasses.replace(transitions[0], report=np.stack([each.report for each in transitions]))
        metrics = rollout_metrics(self.task, steps, steps.episode_return, steps.episode_length)
        return metrics | {name: np.asarray(logged[key]) for name, key in LOSSES.items()}


@contextlib.contextmanager
def _restored_generators() -> Iterator[None]:
    """Restores the random generators of the process and torch's number of threads afterwards.

    torch gets one thread, so that results are the same bit by bit; at this size more threads are no faster.
    """
    import torch

    before = torch.get_rng_state(), np.random.get_state(), random.getstate(), torch.get_num_threads()  # noqa: NPY002
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_rng_state(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        random.setstate(before[2])
        torch.set_num_threads(before[3])
