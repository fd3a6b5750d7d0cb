"""A controller that runs the policy of an ONNX file with onnxruntime."""

import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from flytune.config.pytree import label, pytree, static
from flytune.errors import BadInput, require
from flytune.export.untrusted.onnx_inspection import first_line, inspect, metadata
from flytune.export.untrusted.onnx_session import CONVENTIONS, FORMAT, VERSION, Session, sample_observations

LARGEST = 100_000_000  # bytes; the network of the paper takes 25,000
PROBES = 256
# Rounding takes an action a few times 1e-7 beyond 1. If it is more than 1e-5, the graph has no squashing.
BEYOND_BOX = 1e-5
# The order of sums depends on the batch size. Actions that depend on other rows of the batch differ by tenths.
BATCH_TOLERANCE = 1e-3


@pytree
class OnnxController:
    """A controller whose actions onnxruntime computes, outside of compiled code.

    Compiled code passes all observations of a time step at once and waits for the actions.
    """

    session: Session = static()
    about: dict[str, str] = label(default_factory=dict)  # the metadata of the file: task, vehicle, ...

    def initial_memory(self) -> tuple[()]:
        """An empty memory: the policy depends on the current observation only."""
        return ()

    def act(self, memory: tuple[()], observation: Float[Array, "17"]) -> tuple[tuple[()], Float[Array, "4"]]:
        """The action for one observation, see `Controller`."""
        shape = jax.ShapeDtypeStruct((4,), jnp.float32)
        return memory, jax.pure_callback(self._answer, shape, observation, vmap_method="broadcast_all")

    def _answer(self, observation: Any) -> np.ndarray:
        # NumPy only: a call of JAX from here would wait for the compiled program that waits for this function
        observations = np.asarray(observation)
        shape = (*observations.shape[:-1], 4)
        try:
            return np.clip(self.session(observations.reshape(-1, observations.shape[-1])), -1.0, 1.0).reshape(shape)
        except Exception:  # the probe did not cause it; `fly` reports where and when an action is not finite
            return np.full(shape, np.nan, np.float32)


def load_onnx(path: Path) -> OnnxController:
    """A controller from an ONNX file that maps `observation` [batch, 17] to `action` [batch, 4].

    Raises:
        BadInput: the file is missing or damaged, has other inputs, outputs or conventions, contains more than
            arithmetic, keeps weights in another file, has numbers that are not finite or actions outside [-1, 1]; or
            the extra `onnx` is not installed.
    """
    require("onnx", "onnx")
    require("onnxruntime", "onnx")
    if not os.path.isfile(path):
        what = "is a directory" if os.path.isdir(path) else "no such file"
        raise BadInput(f"{path}: {what}. Give an .onnx policy.")
    try:
        with open(path, "rb") as file:
            content = file.read(LARGEST + 1)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}). Give an .onnx policy.") from None
    if len(content) > LARGEST:
        raise BadInput(
            f"{path}: is larger than {LARGEST // 10**6} MB. Allowed: a policy of up to that size. "
            "Give a smaller network."
        )
    return read_onnx(content, str(path))


def read_onnx(content: bytes, where: str) -> OnnxController:
    """A controller from the content of an ONNX file, see `load_onnx`; errors begin with `where`, the file's name."""
    model = inspect(content, where)
    try:
        session = Session(model.SerializeToString())  # only what was inspected
        _probe(session, where)
    except BadInput:
        raise
    except Exception as error:  # the exceptions of onnxruntime have no common base
        raise BadInput(f"{where}: onnxruntime cannot run it ({first_line(error)}). Export it again.") from None
    about = {key: value for key, value in metadata(model).items() if key not in {*CONVENTIONS, FORMAT, VERSION}}
    return OnnxController(session=session, about=about)


def _probe(session: Session, where: str) -> None:
    """Refuse a model whose actions have another shape, are out of range, or depend on other rows of the batch."""
    observations = sample_observations(PROBES)
    actions = session(observations)
    if actions.shape != (PROBES, 4):
        raise BadInput(
            f"{where}: gives actions of shape {actions.shape} for {PROBES} observations. Allowed: ({PROBES}, 4)."
        )
    if not np.all(np.isfinite(actions)):
        raise BadInput(f"{where}: gives an action that is not finite for a finite observation. Train it again.")
    if (largest := np.abs(actions).max()) > 1 + BEYOND_BOX:
        raise BadInput(
            f"{where}: gives actions up to {largest:.3g} in size. Allowed: -1 to 1. "
            "Put the squashing (Clip or Tanh) into the model."
        )
    for index in (0, 1, PROBES - 1):
        alone = session(observations[index : index + 1])
        if alone.shape != (1, 4) or np.abs(alone[0] - actions[index]).max() > BATCH_TOLERANCE:
            raise BadInput(
                f"{where}: gives another action for an observation that is alone in its batch. "
                "Allowed: each action depends on its own observation only."
            )
