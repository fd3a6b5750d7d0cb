"""Two perceptrons that learn from the same minibatches, each in a thread of its own, as one kernel.

The perceptrons share nothing but the length of their gradients, by which both may be clipped: one number per minibatch,
which the threads give to each other, see `exchange`. All epochs are one call, so that nothing is copied between
minibatches.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from flytune.kernels.dense import backward_function, forward_function, parameters_of
from flytune.kernels.exchange import exchange_functions, two_threads
from flytune.kernels.native import architecture, loop, module, register
from flytune.kernels.writer import Writer

MOMENTS = 3  # numbers that the optimiser keeps and changes for each parameter: itself and two means
ALIGNED = 16  # numbers in a line of the cache

Cost = Callable[[Any, Any, Any, Any], tuple[Any, Any]]
Descent = Callable[[Any, Any, Any, Any, Any], Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Learner:
    """A perceptron and what it minimises."""

    sizes: tuple[int, ...]  # of the inputs, the hidden layers and the outputs
    further: int  # parameters [F] that follow those of the perceptron
    columns: int  # of a sample: the inputs, then what else the cost needs
    recorded: int  # numbers that the cost records of a sample
    cost: Cost  # (further [F], numbers [G], outputs [O], rest of the sample) -> (cost of a sample, recorded [R])

    @property
    def parameters(self) -> int:
        """The number of all parameters."""
        return parameters_of(self.sizes) + self.further


def learn(
    learners: tuple[Learner, Learner],
    descent: Descent,
    threads: Int[Array, ""],
    orders: Int[Array, "T N"],
    numbers: Float[Array, "T G"],
    samples: Sequence[Array],
    states: Sequence[Array],
    kept: int,
) -> tuple[list[Array], list[Array]]:
    """The states [3, P] of both learners after all minibatches, and the sums of the records of the last ones [kept, R].

    Args:
        learners: what learns.
        descent: (numbers [G], squared length of the own gradient, that of the other's, gradient, state [3]) -> state
            [3], of one parameter.
        threads: that may run; with one the results are the same bit by bit.
        orders: the samples of each minibatch.
        numbers: what else is known of each minibatch.
        samples: [S, columns] of each learner.
        states: the parameters of each learner, and two numbers more for each parameter.
        kept: the number of minibatches whose record is kept; a divisor of T.
    """
    steps, width = orders.shape
    plan = _Plan(learners, steps, width, numbers.shape[1], kept)
    outputs = [jax.ShapeDtypeStruct((2, steps), jnp.float32)]
    for learner in learners:
        shapes = (2, MOMENTS, learner.parameters), (kept, learner.recorded), (_Room(learner, width).size,)
        outputs += [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    inputs = [threads, orders, numbers, samples[0], states[0], samples[1], states[1]]
    name, text = module(_functions(plan, descent), "learn", len(inputs), len(outputs))
    register(name, text)
    results = jax.ffi.ffi_call(name, outputs, vmap_method="sequential")(*inputs)
    return [results[index][steps % 2] for index in (1, 4)], [results[index] for index in (2, 5)]


@dataclasses.dataclass(frozen=True, eq=False)
class _Plan:
    """What the kernel is made from."""

    learners: tuple[Learner, Learner]
    steps: int
    width: int  # of a minibatch
    numbers: int  # known of each minibatch
    kept: int


class _Room:
    """Where the arrays of a learner lie in the memory that it works in, in numbers from its start."""

    def __init__(self, learner: Learner, width: int) -> None:
        largest, outputs = max(learner.sizes), learner.sizes[-1]
        lengths = [learner.columns * width, *(size * width for size in learner.sizes[1:])]
        lengths += [outputs * width, learner.further * width, learner.recorded * width, learner.parameters, 1]
        lengths += [largest * width] * 3
        starts = [0, *itertools.accumulate(-(-length // ALIGNED) * ALIGNED for length in lengths)]
        layers = len(learner.sizes) - 1
        self.sample, self.activations = 0, starts[1 : 1 + layers]
        self.outputs, self.further, self.recorded, self.gradient, self.square, *self.spare, self.size = starts[
            1 + layers :
        ]


def _functions(plan: _Plan, descent: Descent) -> list[str]:
    """In LLVM: threads, orders, numbers, samples and states -> squares of gradients, states, records, room."""
    buffers = [f"%in{index}" for index in range(7)] + [f"%out{index}" for index in range(7)]
    parts = [_Part(plan, index) for index in range(2)]
    texts = exchange_functions(architecture())
    for part in parts:
        texts += part.functions(descent)
    for name, chosen in (("alone0", parts[:1]), ("alone1", parts[1:]), ("both", parts)):
        writer = Writer()

        def step(t: str, writer: Writer = writer, chosen: Sequence[_Part] = chosen) -> None:
            for part in chosen:
                part.find_gradient(writer, t)
            for part in chosen:
                part.descend(writer, t)

        for part in chosen:
            part.gather(writer, "0")
        writer.each(plan.steps, step)
        texts.append(writer.function(name, 7, 7, shared=True))
    writer = Writer()
    writer.each(2 * plan.steps, lambda index: writer.call("empty", writer.at("%out0", index)))
    for index, part in enumerate(parts):
        writer.copy(f"%in{4 + 2 * index}", f"%out{1 + 3 * index}", MOMENTS * part.learner.parameters)
    writer.call("run", *buffers)
    return [*texts, two_threads("run", buffers, "%in0", ("alone0", "alone1"), "both"), writer.function("learn", 7, 7)]


class _Part:
    """The instructions of one learner."""

    def __init__(self, plan: _Plan, index: int) -> None:
        self._plan, self._index = plan, index
        self.learner = plan.learners[index]
        self._room = _Room(self.learner, plan.width)
        self._samples, self._states, self._records, self._memory = (
            f"%in{3 + 2 * index}",
            f"%out{1 + 3 * index}",
            f"%out{2 + 3 * index}",
            f"%out{3 + 3 * index}",
        )

    def functions(self, descent: Descent) -> list[str]:
        """The functions in LLVM that the two below call."""
        learner, plan, k = self.learner, self._plan, self._index
        number, inputs = jnp.float32, [learner.further, plan.numbers, learner.sizes[-1]]
        inputs.append(learner.columns - learner.sizes[0])
        kinds = [jax.ShapeDtypeStruct((length,), number) for length in inputs]

        def slopes(further: Any, numbers: Any, outputs: Any, rest: Any) -> Any:
            def mean(further: Any, outputs: Any) -> Any:
                cost, recorded = learner.cost(further, numbers, outputs, rest)
                return cost / plan.width, recorded

            (of_further, of_outputs), recorded = jax.grad(mean, (0, 1), has_aux=True)(further, outputs)
            return of_outputs, of_further, recorded

        one = jax.ShapeDtypeStruct((), number)
        state = jax.ShapeDtypeStruct((MOMENTS,), number)
        cost, step = jax.make_jaxpr(slopes)(*kinds), jax.make_jaxpr(descent)(kinds[1], one, one, one, state)
        return [
            self._gather(),
            forward_function(f"forward{k}", learner.sizes, plan.width, False),
            loop(f"cost{k}", cost, [False, False, True, True], plan.width),
            backward_function(f"backward{k}", learner.sizes, plan.width, False, below=False),
            self._measure(),
            loop(f"descend{k}", step, [False, False, False, True, True], learner.parameters),
        ]

    def _gather(self) -> str:
        """In LLVM: order, samples -> the samples of a minibatch, one behind the other along the last axis."""
        writer, columns, width = Writer(), self.learner.columns, self._plan.width

        def copy(index: str) -> None:
            source, target = writer.row("%in1", writer.at("%in0", index), columns), writer.at("%out0", index)
            for column in range(columns):
                writer.copy_one(writer.at(source, column), writer.at(target, column * width))

        writer.each(width, copy)
        return writer.function(f"gather{self._index}", 2, 1)

    def _measure(self) -> str:
        """In LLVM: slopes of further parameters, records of samples -> gradient, its squared length, sums."""
        writer, network, width = Writer(), parameters_of(self.learner.sizes), self._plan.width
        for index in range(self.learner.further):
            writer.total(writer.at("%in0", index * width), writer.at("%out0", network + index), width)
        for index in range(self.learner.recorded):
            writer.total(writer.at("%in1", index * width), writer.at("%out2", index), width)
        writer.total("%out0", "%out1", self.learner.parameters, square=True)
        return writer.function(f"measure{self._index}", 2, 3)

    def find_gradient(self, writer: Writer, t: str) -> None:
        """Write the instructions that find and publish the gradient of minibatch t, whose samples are collected."""
        learner, k, width, room = self.learner, self._index, self._plan.width, self._room
        state, numbers = self._two_states(writer, t)[0], self._numbers(writer, t)

        def at(place: int) -> str:
            return writer.at(self._memory, place)

        sample, outputs, further, gradient, square = map(
            at, (room.sample, room.outputs, room.further, room.gradient, room.square)
        )
        activations, spare, recorded = list(map(at, room.activations)), list(map(at, room.spare)), at(room.recorded)
        rest, given = writer.at(sample, learner.sizes[0] * width), writer.at(state, parameters_of(learner.sizes))
        record = writer.at(self._records, writer.times(writer.remainder(t, self._plan.kept), learner.recorded))
        writer.call(f"forward{k}", state, sample, *activations)
        writer.call(f"cost{k}", given, numbers, activations[-1], rest, outputs, further, recorded)
        writer.call(f"backward{k}", state, sample, *activations, outputs, gradient, square, *spare)
        writer.call(f"measure{k}", further, recorded, gradient, square, record)
        writer.call("publish", square, self._cell(writer, t, k))
        # not later, because the other learner may need the time until it has published its own
        self.gather(writer, writer.remainder(writer.times(t, 1, 1), self._plan.steps))

    def gather(self, writer: Writer, t: str) -> None:
        """Write the instructions that collect the samples of minibatch t."""
        order, sample = writer.at("%in1", writer.times(t, self._plan.width)), writer.at(self._memory, self._room.sample)
        writer.call(f"gather{self._index}", order, self._samples, sample)

    def descend(self, writer: Writer, t: str) -> None:
        """Write the instructions that wait for the other's gradient of minibatch t and make the step."""
        own, other = (self._cell(writer, t, index) for index in (self._index, 1 - self._index))
        gradient, (old, new) = writer.at(self._memory, self._room.gradient), self._two_states(writer, t)
        writer.call("wait", other)
        writer.call(f"descend{self._index}", self._numbers(writer, t), own, other, gradient, old, new)

    def _numbers(self, writer: Writer, t: str) -> str:
        return writer.at("%in2", writer.times(t, self._plan.numbers))

    def _cell(self, writer: Writer, t: str, index: int) -> str:
        return writer.at("%out0", writer.times(t, 1, index * self._plan.steps))

    def _two_states(self, writer: Writer, t: str) -> list[str]:
        """The state before minibatch t and the room for the one after it, which take turns."""
        size = MOMENTS * self.learner.parameters
        return [
            writer.at(self._states, writer.times(writer.remainder(writer.times(t, 1, ahead), 2), size))
            for ahead in (0, 1)
        ]
