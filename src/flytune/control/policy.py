"""Learned controllers: the network, the policy around it, and its file."""

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import Array, Float

from flytune.config import document
from flytune.config.files import write_bytes
from flytune.config.pytree import label, pytree, static
from flytune.errors import BadInput
from flytune.physics.vehicle import Vehicle
from flytune.task import observation
from flytune.task.dial import Dial, Input, Setting, checked_setting, number_of_inputs, read_named, told
from flytune.task.observation import RATE, SIZE

FORMAT = "flytune-policy-1"
HEADER = "flytune"  # one entry: safetensors writes several in an order that changes from process to process
MOTORS = "; 0 (+x, -y), 1 (-x, -y), 2 (-x, +y), 3 (+x, +y)"
ACTIONS = {  # `Vehicle.action_convention` -> what an action is
    "hover_relative": f"4 motors [-1, 1]: rotor speed = hover speed * (1 + action_scale * action){MOTORS}",
    "rotor_speed": f"4 motors [-1, 1]: rotor speed, linear from the least at -1 to the largest at 1{MOTORS}",
    "thrust": f"4 motors [-1, 1]: thrust, linear from the least at -1 to the largest at 1{MOTORS}",
}
ACTION = ACTIONS["hover_relative"]
CONVENTIONS = {"observation": observation.LAYOUT, "action": ACTION, "rate": f"{RATE} Hz"}  # unless `about` says others


@pytree
class Network:
    """A multilayer perceptron with tanh between its layers and none after the last."""

    weights: tuple[Float[Array, "_ _"], ...]  # inputs x outputs
    biases: tuple[Float[Array, "_"], ...]

    @property
    def sizes(self) -> tuple[int, ...]:
        """The numbers of inputs, of each hidden layer and of outputs."""
        return (*(weight.shape[0] for weight in self.weights), self.weights[-1].shape[1])

    def __call__(self, inputs: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """The outputs for one input or a batch of them."""
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            inputs = jnp.tanh(inputs @ weight + bias)
        return inputs @ self.weights[-1] + self.biases[-1]


def make_network(key: jax.Array, sizes: Sequence[int], last_gain: float) -> Network:
    """A network with orthogonal weights (gain sqrt 2, and `last_gain` in the last layer) and zero biases.

    Source: the initialisation of Stable-Baselines3's actor-critic (paper R17).
    """
    gains = [2**0.5] * (len(sizes) - 2) + [last_gain]
    layers = zip(gains, jax.random.split(key, len(gains)), itertools.pairwise(sizes), strict=True)
    return Network(
        weights=tuple(jax.nn.initializers.orthogonal(gain)(k, shape) for gain, k, shape in layers),
        biases=tuple(jnp.zeros(size) for size in sizes[1:]),
    )


def with_output(network: Network, value: Any) -> Network:
    """The network with the same bias for each of its outputs."""
    *others, last = network.biases
    return dataclasses.replace(network, biases=(*others, jnp.full_like(last, value)))


@pytree
class Policy:
    """A learned controller: the deterministic action of its actor, squashed into [-1, 1].

    A policy with dials flies at its `setting`; `at` gives the same policy at another one.
    """

    actor: Network
    input_scale: Float[Array, "17"]  # the observation times this is the input of the actor
    squash: Literal["clip", "tanh"] = static()  # PPO: the mean is clipped; analytic policy gradient: smooth
    error_limit: Any = math.inf  # m; a position error that is longer is shortened to this, as of a nearer target
    dials: dict[str, Dial] = dataclasses.field(default_factory=dict)  # empty for a policy with one response
    inputs: dict[str, Input] = dataclasses.field(default_factory=dict)  # of the actor, behind the observation
    setting: dict[str, Any] = dataclasses.field(default_factory=dict)  # dial -> its value
    bounds: Float[Array, "2 17"] | None = None  # lowest and highest of the observation, beyond which it is clipped
    about: dict[str, Any] = label(default_factory=dict)  # task, vehicle, trainer: in the header of the file
    maps: dict[str, Any] = label(default_factory=dict)  # dial -> its measured response, see control/response_map.py

    def __call__(
        self, observation: Float[Array, "*batch 17"], setting: Setting | None = None
    ) -> Float[Array, "*batch 4"]:
        """The action in [-1, 1] for one observation or a batch of them, at a setting; its own where None."""
        observation = limited(observation, self.error_limit)
        clipped = observation if self.bounds is None else jnp.clip(observation, *self.bounds)
        scaled = clipped * self.input_scale
        if self.inputs:  # these are not scaled
            further = told(self.inputs, observation, self.setting if setting is None else setting)[..., SIZE:]
            scaled = jnp.concatenate([scaled, further], axis=-1)
        raw = self.actor(scaled)
        return jnp.tanh(raw) if self.squash == "tanh" else jnp.clip(raw, -1.0, 1.0)

    def __repr__(self) -> str:
        sizes = "-".join(map(str, self.actor.sizes))
        known = {"task", "vehicle"} <= self.about.keys()
        made_for = f", {self.about['task']} on {self.about['vehicle']}" if known else ""
        dials = "".join(f", {name} {float(self.setting[name]):g}" for name in self.dials)
        return f"Policy({sizes}, {self.squash}{made_for}{dials})"

    def at(self, setting: Setting | None = None, /, **values: Any) -> "Policy":
        """The policy with its dials set; a dial that is not named keeps its value.

        Raises:
            BadInput: an unknown dial, or a value out of range.
        """
        wanted = {**self.setting, **(setting or {}), **values}
        return dataclasses.replace(self, setting=checked_setting(self.dials, wanted))

    def fixed(self) -> "Policy":
        """The policy of the 17 observations alone that gives the same actions as this one at its setting.

        At a fixed setting every further input is a constant, or a multiple of a part of the observation. So it becomes
        a part of the first bias, or of the first weights.
        """
        first, *others = self.actor.weights
        bias, *biases = self.actor.biases
        first, bias = np.array(first), np.array(bias)  # of NumPy, whose slices compile nothing
        weight, further = first[:SIZE], first[SIZE:]
        for name in sorted(self.inputs):
            each = self.inputs[name]
            value, (mine, further) = float(each.value.value(self.setting)), np.split(further, [each.size])
            if (rows := each.rows()) is None:
                bias += value * mine[0]
            else:
                weight[rows] += value * mine / np.asarray(self.input_scale)[rows, None]
        actor = Network(weights=(jnp.asarray(weight), *others), biases=(jnp.asarray(bias), *biases))
        return dataclasses.replace(self, actor=actor, dials={}, inputs={}, setting={}, maps={})

    def initial_memory(self) -> tuple[()]:
        """Nothing: the policy is a function of the observation alone."""
        return ()

    def act(self, memory: tuple[()], observation: Float[Array, "17"]) -> tuple[tuple[()], Float[Array, "4"]]:
        """The action of one observation, see `Controller`."""
        return memory, self(observation)


def limited(observation: Float[Array, "*batch 17"], error_limit: Any) -> Float[Array, "*batch 17"]:
    """The observation with a position error of at most `error_limit` in m; a shorter one stays as it is, bit by bit."""
    error = observation[..., :3]
    length = jnp.sqrt(jnp.sum(error * error, axis=-1, keepdims=True))
    factor = jnp.where(length > error_limit, error_limit / length, 1.0)
    return jnp.concatenate([factor * error, observation[..., 3:]], axis=-1)


def conventions(about: Mapping[str, Any]) -> dict[str, str]:
    """What the numbers of a policy mean, for the header of its file, from the facts about it."""
    found = dict(CONVENTIONS)
    if convention := about.get("action_convention"):
        found["action"] = ACTIONS[convention]
    if rate := about.get("control_rate"):
        found["rate"] = f"{rate} Hz"
    return found


def facts_of_vehicle(vehicle: Vehicle) -> dict[str, Any]:
    """The facts about a policy that its vehicle decides, for `Policy.about`; the usual conventions are left out."""
    facts: dict[str, Any] = {"vehicle": vehicle.name}
    if vehicle.action_convention != "hover_relative":
        facts["action_convention"] = vehicle.action_convention
    if vehicle.control_rate != RATE:
        facts["control_rate"] = vehicle.control_rate
    return facts


def check_actions_fit(about: Mapping[str, Any], vehicle: Vehicle, name: str) -> None:
    """Refuse a vehicle for which the actions of a policy mean something else.

    Raises:
        BadInput: both conventions, and the remedy.
    """
    own = about.get("action_convention", "hover_relative")
    if own != vehicle.action_convention:
        raise BadInput(
            f"{name or 'policy'}: its actions follow the convention {own}, and those of the vehicle {vehicle.name} "
            f"{vehicle.action_convention}. Give a vehicle with action_convention = {own}, or train a policy for it."
        )


def save_policy(path: Path, policy: Policy) -> None:
    """Write a policy as safetensors; its header has the conventions and `about`, as JSON.

    Raises:
        BadInput: the file cannot be written.
    """
    tensors = {"input_scale": np.asarray(policy.input_scale)}
    if policy.bounds is not None:
        tensors["bounds"] = np.asarray(policy.bounds)
    for part, layers in (("weight", policy.actor.weights), ("bias", policy.actor.biases)):
        tensors |= {f"actor.{index}.{part}": np.asarray(layer) for index, layer in enumerate(layers)}
    header = {"format": FORMAT, "squash": policy.squash, **conventions(policy.about), "about": policy.about}
    if math.isfinite(policy.error_limit):
        header["error_limit"] = float(policy.error_limit)
    if policy.dials:
        for part in ("dials", "inputs"):
            header[part] = {name: document.plain(each) for name, each in getattr(policy, part).items()}
        header["setting"] = {name: float(value) for name, value in policy.setting.items()}
        header["maps"] = policy.maps
    write_bytes(path, safetensors.numpy.save(tensors, metadata={HEADER: json.dumps(header, sort_keys=True)}))


def load_policy(path: Path) -> Policy:
    """A policy from its file.

    Raises:
        BadInput: missing, not a policy, of another observation layout, wrongly shaped, or not finite.
    """
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get(HEADER, "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a dict)
    except FileNotFoundError:
        raise BadInput(
            f"{path}: no such file. Give a .safetensors policy; flytune.find_controller also takes run directories and "
            "the names of policies that ship."
        ) from None
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise BadInput(
            f"{path}: is not a policy ({error}). Give a .safetensors file written by flytune; a controller of your own "
            "flies from Python, see examples/own_controller.py."
        ) from None
    header = header if isinstance(header, dict) else {}
    if header.get("format") != FORMAT:
        raise BadInput(f"{path}: is not a flytune policy (format {header.get('format')!r}). Allowed: {FORMAT}.")
    if not all(isinstance(header.get(part, {}), dict) for part in ("about", "maps")):
        raise BadInput(f"{path}: has a damaged header. Train it again.")
    if header.get("observation") not in (observation.LAYOUT, *observation.EARLIER_LAYOUTS):
        raise BadInput(
            f"{path}: was trained on another observation, {header.get('observation')!r}. "
            f"Allowed: {observation.LAYOUT}. Train it again with this version."
        )
    return _assemble(path, header, tensors)


def _assemble(path: Path, header: dict[str, Any], tensors: dict[str, np.ndarray]) -> Policy:
    bounds = tensors.pop("bounds", None)
    layers = (len(tensors) - 1) // 2
    names = {"input_scale", *(f"actor.{i}.{part}" for i in range(layers) for part in ("weight", "bias"))}
    if layers < 1 or set(tensors) != names or header.get("squash") not in ("clip", "tanh"):
        raise BadInput(f"{path}: is a damaged policy (tensors {sorted(tensors)}). Train it again.")
    weights, biases = ([tensors[f"actor.{i}.{part}"] for i in range(layers)] for part in ("weight", "bias"))
    dials, inputs, setting = _dials(path, header)
    error_limit = header.get("error_limit", math.inf)
    if type(error_limit) not in (int, float) or not error_limit > 0:
        raise BadInput(f"{path}: has an error limit of {error_limit!r}, allowed: above 0 m. Train it again.")
    width = SIZE + number_of_inputs(inputs)
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        wanted = (width, weight.shape[1]) if weight.ndim == 2 else "a matrix"
        if weight.shape != wanted or bias.shape != weight.shape[1:]:
            raise BadInput(f"{path}: layer {index} has shape {weight.shape}, allowed: {wanted}. Train it again.")
        width = weight.shape[1]
    if width != 4 or tensors["input_scale"].shape != (SIZE,):
        raise BadInput(f"{path}: maps {tensors['input_scale'].shape} to {width}, allowed: 17 to 4. Train it again.")
    if bounds is not None and (bounds.shape != (2, SIZE) or not np.all(bounds[0] <= bounds[1])):
        raise BadInput(f"{path}: its bounds are damaged. Train it again.")
    for name, tensor in tensors.items():
        if not np.all(np.isfinite(tensor)):
            raise BadInput(f"{path}: {name} holds numbers that are not finite. Train it again.")
    return Policy(
        actor=Network(weights=tuple(map(jnp.asarray, weights)), biases=tuple(map(jnp.asarray, biases))),
        input_scale=jnp.asarray(tensors["input_scale"]),
        squash=header["squash"],
        error_limit=float(error_limit),
        dials=dials,
        inputs=inputs,
        setting=setting,
        bounds=None if bounds is None else jnp.asarray(bounds),
        about=header.get("about", {}),
        maps=header.get("maps", {}),
    )


def _dials(path: Path, header: dict[str, Any]) -> tuple[dict[str, Dial], dict[str, Input], dict[str, float]]:
    """The dials of a policy's header, its further inputs and its setting."""
    dials = read_named(Dial, header.get("dials", {}), f"{path}: dials")
    inputs = read_named(Input, header.get("inputs", {}), f"{path}: inputs")
    given = header.get("setting", {})
    setting = checked_setting(dials, given if isinstance(given, dict) else {}, f"{path}: setting")
    for name, each in inputs.items():
        try:
            for values in ({dial: getattr(dials[dial], end) for dial in dials} for end in ("lowest", "highest")):
                each.value.value(values)
        except (ArithmeticError, ValueError) as error:
            raise BadInput(f"{path}: input {name} is damaged ({error}). Train it again.") from None
    return dials, inputs, setting
