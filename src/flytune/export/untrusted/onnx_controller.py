"""A policy from an ONNX file, flown with onnxruntime."""

import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from flytune.config.pytree import label, pytree, static
from flytune.errors import BadInput
from flytune.export.untrusted.onnx_inspection import first_line, inspect, metadata
from flytune.export.untrusted.onnx_session import CONVENTIONS, FORMAT, VERSION, Session, sample_observations
from flytune.extras import require

LARGEST = 100_000_000  # bytes; the paper's network takes 25,000
PROBES = 256
# The last tanh and what follows it round: a few times 1e-7. Beyond 1e-5 the graph has no squashing.
BEYOND_BOX = 1e-5
# Sums of another batch size run in another order; actions that mix up their batch differ by tenths.
BATCH_TOLERANCE = 1e-3


@pytree
class OnnxController:
    """A controller whose actions onnxruntime works out, outside of compiled code.

    Compiled code hands it all observations of a step at once and waits for the answer.
    """

    session: Session = static()
    about: dict[str, str] = label(default_factory=dict)  # task, vehicle, ...: what the file's metadata says

    def initial_memory(self) -> tuple[()]:
        """Nothing: the policy is a function of the observation alone."""
        return ()

    def act(self, memory: tuple[()], observation: Float[Array, "17"]) -> tuple[tuple[()], Float[Array, "4"]]:
        """The action of one observation, see `Controller`."""
        shape = jax.ShapeDtypeStruct((4,), jnp.float32)
        return memory, jax.pure_callback(self._answer, shape, observation, vmap_method="broadcast_all")

    def _answer(self, observation: Any) -> np.ndarray:
        # NumPy only: work that is handed to JAX from in here would wait for the program that waits for us
        seen = np.asarray(observation)
        wanted = (*seen.shape[:-1], 4)
        try:
            return np.clip(self.session(seen.reshape(-1, seen.shape[-1])), -1.0, 1.0).reshape(wanted)
        except Exception:  # not on any observation of the probe; `fly` says where and when an action is not finite
            return np.full(wanted, np.nan, np.float32)


def load_onnx(path: Path) -> OnnxController:
    """A controller from an ONNX file that maps `observation` [batch, 17] to `action` [batch, 4].

    Raises:
        BadInput: missing, damaged, of other inputs, outputs or conventions, more than arithmetic, weights in another
            file or not finite, or actions outside [-1, 1]; or the extra `onnx` is not installed.
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
        raise BadInput(f"{path}: is larger than {LARGEST // 10**6} MB. Allowed: a policy of up to that size.")
    return read_onnx(content, str(path))


def read_onnx(content: bytes, where: str) -> OnnxController:
    """A controller from the content of an ONNX file, see `load_onnx`; errors name `where`."""
    model = inspect(content, where)
    try:
        session = Session(model.SerializeToString())  # what was inspected, and nothing besides
        _probe(session, where)
    except BadInput:
        raise
    except Exception as error:  # onnxruntime has a dozen kinds, with no base of their own
        raise BadInput(f"{where}: onnxruntime cannot run it ({first_line(error)}). Export it again.") from None
    about = {key: value for key, value in metadata(model).items() if key not in {*CONVENTIONS, FORMAT, VERSION}}
    return OnnxController(session=session, about=about)


def _probe(session: Session, where: str) -> None:
    """Refuse a model by what it answers: shape, range, and that a vehicle's action is its own whoever flies beside."""
    observations = sample_observations(PROBES)
    actions = session(observations)
    if actions.shape != (PROBES, 4):
        raise BadInput(f"{where}: answers {PROBES} observations with shape {actions.shape}. Allowed: ({PROBES}, 4).")
    if not np.all(np.isfinite(actions)):
        raise BadInput(f"{where}: answers a finite observation with an action that is not. Train it again.")
    if (largest := np.abs(actions).max()) > 1 + BEYOND_BOX:
        raise BadInput(
            f"{where}: gives actions up to {largest:.3g} in size. Allowed: -1 to 1. "
            "Put the squashing (Clip or Tanh) into the model."
        )
    for index in (0, 1, PROBES - 1):
        alone = session(observations[index : index + 1])
        if alone.shape != (1, 4) or np.abs(alone[0] - actions[index]).max() > BATCH_TOLERANCE:
            raise BadInput(
                f"{where}: answers an observation otherwise when it is alone in its batch. "
                "Allowed: each action from its own observation."
            )
