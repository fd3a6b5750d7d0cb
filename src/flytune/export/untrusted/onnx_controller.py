"""A controller that runs the policy of an ONNX file with onnxruntime."""

import dataclasses
import hashlib
import os
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from flytune.config.pytree import label, pytree, static
from flytune.control.policy import CONVENTIONS
from flytune.errors import BadInput, require
from flytune.export.untrusted.onnx_inspection import (
    DIALS,
    FORMAT,
    VERSION,
    conventions_of,
    inspect,
    metadata,
    read_dials,
)
from flytune.export.untrusted.onnx_shapes import Ports, find_ports
from flytune.export.untrusted.sandbox import LOAD_TIME, SANDBOX, STEP_TIME, Stopped
from flytune.task.dial import Dial, Setting, checked_setting
from flytune.task.observation import SIZE

LARGEST = 100_000_000  # bytes; the network of the paper takes 25,000
PROBES = 256
# Rounding takes an action a few times 1e-7 beyond 1. If it is more than 1e-5, the graph has no squashing.
BEYOND_BOX = 1e-5
# The order of sums depends on the batch size. Actions that depend on other rows of the batch differ by tenths.
BATCH_TOLERANCE = 1e-3


class Session:
    """A model that is ready to run; two sessions of the same content are equal, so they share a compiled program.

    Raises:
        BadInput: it is damaged, or onnxruntime cannot run it; the message says what, without the name of the file.
    """

    _stopped: ClassVar[dict[str, str]] = {}  # digest -> why that model was stopped; it is not asked again

    def __init__(self, content: bytes, ports: Ports) -> None:
        self._content, self._ports = content, ports
        self._digest = hashlib.sha256(content).hexdigest()
        self._stopped.pop(self._digest, None)
        self._load()

    @property
    def failure(self) -> str | None:
        """Why the model was stopped, None where it was not."""
        return self._stopped.get(self._digest)

    def _load(self) -> None:
        try:
            answer, _ = SANDBOX.ask({"do": "load", "key": self._digest}, self._content, LOAD_TIME)
        except Stopped as stopped:
            raise BadInput(f"{stopped} while it is loaded. Give a smaller network.") from None
        if problem := answer.get("problem"):
            raise BadInput(problem)

    def __call__(
        self, observations: Float[np.ndarray, "batch 17"], dial: Float[np.ndarray, "_ dials"] | None = None
    ) -> Float[np.ndarray, "batch 4"]:
        """The actions for a batch of observations, at the setting of each, or at one setting of the dials for all.

        Raises:
            BadInput: it was stopped, or cannot be run on these observations.
        """
        rows, inputs, parts = len(observations), [], []
        values = [observations] if dial is None else [observations, dial]
        for port, numbers in zip(self._ports.inputs, values, strict=False):  # a model without dials ignores them
            given = np.asarray(np.broadcast_to(numbers, (rows, numbers.shape[-1])), port.type)
            inputs.append((port.name, port.type, [rows, *(given.shape[1:] if port.bare else port.row)]))
            parts.append(given.tobytes())
        request = {"do": "run", "key": self._digest, "inputs": inputs, "output": self._ports.output, "rows": rows}
        request |= {"batch": self._ports.batch, "whole": {port.name: port.whole for port in self._ports.inputs}}
        answer, content = self._ask(request, b"".join(parts))
        if "forgotten" in answer:  # the process was started anew, or has met many models since
            self._load()
            answer, content = self._ask(request, b"".join(parts))
        if problem := answer.get("problem"):
            self._stopped[self._digest] = problem
            raise BadInput(problem)
        return np.frombuffer(content, np.float32).reshape(answer["shape"])

    def _ask(self, request: dict[str, Any], content: bytes) -> tuple[dict[str, Any], bytes]:
        if self.failure is None:
            try:
                return SANDBOX.ask(request, content, STEP_TIME)
            except Stopped as stopped:
                self._stopped[self._digest] = f"{stopped} for the actions of one time step. Give a smaller network."
        raise BadInput(self.failure)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Session) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)


@pytree
class OnnxController:
    """A controller whose actions onnxruntime computes, outside of compiled code.

    Compiled code passes all observations of a time step at once and waits for the actions.
    """

    session: Session = static()
    dials: dict[str, Dial] = dataclasses.field(default_factory=dict)
    setting: dict[str, Any] = dataclasses.field(default_factory=dict)  # dial -> its value
    about: dict[str, str] = label(default_factory=dict)  # the metadata of the file: task, vehicle, ...

    def at(self, setting: Setting | None = None, /, **values: Any) -> "OnnxController":
        """The controller with its dials set; a dial that is not named keeps its value.

        Raises:
            BadInput: an unknown dial, or a value out of range.
        """
        wanted = {**self.setting, **(setting or {}), **values}
        return dataclasses.replace(self, setting=checked_setting(self.dials, wanted))

    def __call__(self, observation: Float[Array, "17"], setting: Setting | None = None) -> Float[Array, "4"]:
        """The action for one observation, at a setting; its own where None."""
        setting, shape = self.setting if setting is None else setting, jax.ShapeDtypeStruct((4,), jnp.float32)
        dial = jnp.asarray([setting[name] for name in sorted(self.dials)], jnp.float32)
        return jax.pure_callback(self._answer, shape, observation, dial, vmap_method="broadcast_all")

    def initial_memory(self) -> tuple[()]:
        """An empty memory: the policy depends on the current observation only."""
        return ()

    def act(self, memory: tuple[()], observation: Float[Array, "17"]) -> tuple[tuple[()], Float[Array, "4"]]:
        """The action for one observation, see `Controller`."""
        return memory, self(observation)

    def _answer(self, observation: Any, dial: Any = ()) -> np.ndarray:
        # NumPy only: a call of JAX from here would wait for the compiled program that waits for this function
        observations, dials = np.asarray(observation), np.asarray(dial)
        shape = (*observations.shape[:-1], 4)
        rows = observations.reshape(-1, observations.shape[-1])
        settings = dials.reshape(-1, dials.shape[-1]) if dials.size else None
        try:
            return np.clip(self.session(rows, settings), -1.0, 1.0).reshape(shape)
        except Exception:  # the probe did not cause it; `fly` reports where and when, and `failure` may say why
            return np.full(shape, np.nan, np.float32)

    @property
    def failure(self) -> str | None:
        """Why the model was stopped in flight, None where it was not."""
        return self.session.failure


def load_onnx(path: Path) -> OnnxController:
    """A controller from an ONNX file that maps `observation` [batch, 17] to `action` [batch, 4].

    Raises:
        BadInput: the file is missing or damaged, has other inputs, outputs or conventions, contains control flow,
            randomness or operators outside the standard, keeps weights in another file, has numbers that are not finite
            or actions outside [-1, 1], or needs too much memory or time; or the extra `onnx` is not installed.
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
    require("onnxruntime", "onnx")
    model = inspect(content, where)
    dials = read_dials(model, where)
    setting = {name: float(dial.default) for name, dial in dials.items()}
    ports = find_ports(model, len(dials), where)
    try:
        session = Session(model.SerializeToString(), ports)  # only what was inspected
        _probe(session, np.asarray([list(setting.values())], np.float32))
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None
    found = metadata(model)
    about: dict[str, Any] = {
        key: value for key, value in found.items() if key not in {*CONVENTIONS, DIALS, FORMAT, VERSION}
    }
    about |= conventions_of(found)
    return OnnxController(session=session, dials=dials, setting=setting, about=about)


def sample_observations(number: int) -> Float[np.ndarray, "number 17"]:
    """Observations to test a model with, the same ones each time: from close to the target to far beyond any flight.

    The first is hover at the target. In the others each size is log-uniform: a position error of 1 mm to 100 m, a
    rotation of thousandths of a radian to upside down, 1 mm/s to 100 m/s, and 0.01 to 1,000 rad/s.
    """
    random = np.random.default_rng(0)

    def spread(low: float, high: float, width: int) -> np.ndarray:
        return 10 ** random.uniform(low, high, (number, 1)) * random.standard_normal((number, width))

    attitude = np.concatenate([spread(-3, 1, 3), np.ones((number, 1))], axis=-1)
    attitude /= np.linalg.norm(attitude, axis=-1, keepdims=True)
    last_action = np.clip(1.5 * random.uniform(-1, 1, (number, 4)), -1, 1)  # a third of them at a bound
    blocks = [spread(-3, 2, 3), attitude, spread(-3, 2, 3), spread(-2, 3, 3), last_action]
    observations = np.concatenate(blocks, axis=-1).astype(np.float32)
    observations[0] = np.eye(SIZE)[6]  # no error, and the attitude (0, 0, 0, 1)
    return observations


def _probe(session: Session, dial: Float[np.ndarray, "1 dials"]) -> None:
    """Refuse a model whose actions are out of range, or depend on other rows of the batch."""
    observations = sample_observations(PROBES)
    actions = session(observations, dial)
    if not np.all(np.isfinite(actions)):
        raise BadInput("gives an action that is not finite for a finite observation. Train it again.")
    if (largest := np.abs(actions).max()) > 1 + BEYOND_BOX:
        raise BadInput(
            f"gives actions up to {largest:.3g} in size. Allowed: -1 to 1. "
            "Put the squashing (Clip or Tanh) into the model."
        )
    for index in (0, 1, PROBES - 1):
        alone = session(observations[index : index + 1], dial)
        if np.abs(alone[0] - actions[index]).max() > BATCH_TOLERANCE:
            raise BadInput(
                "gives another action for an observation that is alone in its batch. "
                "Allowed: each action depends on its own observation only."
            )
