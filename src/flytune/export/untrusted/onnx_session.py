"""The conventions of a policy in ONNX (names, metadata), and a session of onnxruntime that computes its actions."""

import hashlib

import numpy as np
from jaxtyping import Float

from flytune.control.policy import ACTION
from flytune.errors import require
from flytune.task.observation import LAYOUT, SIZE

INPUT, OUTPUT = "observation", "action"
FORMAT, VERSION = "format", "flytune_version"  # metadata entries that say which program wrote the file
# A graph does not say what its numbers mean: a model without these entries in its metadata is refused.
CONVENTIONS = {"observation": LAYOUT, "action": ACTION, "rate": "100 Hz"}


class Session:
    """A model loaded in onnxruntime; two sessions of the same content are equal, so they share a compiled program."""

    def __init__(self, content: bytes) -> None:
        onnxruntime = require("onnxruntime", "onnx")
        options = onnxruntime.SessionOptions()
        # a network this small needs microseconds, and a single thread repeats its sums bit by bit
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # log nothing: every failure is also an exception
        options.add_session_config_entry("session.load_model_format", "ONNX")
        self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        self._digest = hashlib.sha256(content).digest()

    def __call__(self, observations: Float[np.ndarray, "batch 17"]) -> Float[np.ndarray, "batch 4"]:
        """The actions for a batch of observations."""
        return self._session.run([OUTPUT], {INPUT: np.ascontiguousarray(observations, np.float32)})[0]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Session) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)


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
