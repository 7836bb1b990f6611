"""Many copies of a plant, stepped in place in one call of compiled code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np

from thruster_env.core.checks import options as checked_options
from thruster_env.core.compiled import CompiledOrPython, compiled, function_fingerprint, inlined, is_interpreting
from thruster_env.core.memory import KEY_0, KEY_1, STEP, gathered, new_memory, scatter, set_row
from thruster_env.core.results import as_array
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.core.streams import normal_block
from thruster_env.core.threads import in_parts, worker_threads
from thruster_env.env.plant_data import checked_state
from thruster_env.model.quantities import Quantity

THREADED_BLOCKS = 8  # fewer blocks are done before a second thread has woken up


class PlantCopies:
    """N copies of a plant with a task, each with its own key; a report of them is an array (reported, N).

    A plant's class defines the rows of commands and reports, packs its parameters (`encode`) and finds its
    compiled step, `advance(first, last, memory, numbers, out, begin)` on blocks first ... last - 1: with `begin`
    it starts an episode of every copy from the keys in its memory and takes the first measurement; otherwise it
    applies the commands for one sample time. It writes its report to out (reported, blocks, width).

    Attributes:
        commands: rows of the memory that hold the inputs of the next step.
        reported: the row after the last one that a step reports.
    """

    commands: tuple[int, ...]
    reported: ClassVar[int]
    advance: Callable

    def __init__(self, plant: Any, task: Any, count: int):
        """Allocate the memory of `count` copies; call `begin` next."""
        self.plant, self.task, self.count = plant, task, count
        self.numbers, rows = self.encode(plant)
        self.memory = new_memory(count, rows)
        self._find_machine_code()

    def encode(self, plant: Any) -> tuple[np.ndarray, int]:
        """Packed parameters of a plant with the task, which the compiled step reads, and a copy's rows of memory.

        The rows in front (`thruster_env.core.memory.FRONT`) are included.
        """
        raise NotImplementedError

    def machine_code(self) -> tuple[Callable, CompiledOrPython]:
        """The compiled step, and the same for several threads, from `machine_code_of`."""
        raise NotImplementedError

    def numbers_from(self, options: Mapping | None) -> np.ndarray | None:
        """Numbers for `begin` with the initial state that a reset's options fix in "state", or None.

        Raises ValueError for other options.
        """
        start = checked_options(options).get("state")
        if start is None:
            return None
        n = len(self.plant.initial_mean)
        state = checked_state("the state of options", start, n)
        return self.encode(self.plant._replace(initial_mean=state, initial_cov=np.zeros((n, n))))[0]

    def prepare(self, memory: np.ndarray, keys: np.ndarray) -> None:
        """Write further initial values of episodes with keys (count, 2), such as random parameters."""

    def _find_machine_code(self) -> None:
        self.advance, self._advance_in_parts = self.machine_code()

    def __getstate__(self) -> dict:
        """All but the machine code, which pickle cannot hold and every process finds for itself."""
        return {key: value for key, value in vars(self).items() if key not in ("advance", "_advance_in_parts")}

    def __setstate__(self, state: dict) -> None:
        """Find the machine code for the restored memory."""
        vars(self).update(state)
        self._find_machine_code()

    @property
    def bytes_per_copy(self) -> int:
        """Memory per copy."""
        return self.memory.nbytes // (self.memory.shape[0] * self.memory.shape[2])

    def begin(self, keys: np.ndarray, which: np.ndarray | None = None, numbers=None) -> np.ndarray:
        """Start episodes with keys (count, 2) for all copies, or for those named by `which`; return their report.

        `numbers` may replace the plant's own, with another initial state.
        """
        numbers = self.numbers if numbers is None else numbers
        memory = self.memory if which is None else gathered(self.memory, which)
        set_row(memory, KEY_0, keys[:, 0])
        set_row(memory, KEY_1, keys[:, 1])
        self.prepare(memory, keys)
        out = self._run(memory, numbers, True)
        if which is not None:
            scatter(memory, self.memory, which)
        return out[:, : len(keys)]

    def step(self, commands: np.ndarray) -> np.ndarray:
        """Apply commands (N,) of one input, or (N, p), for one sample time; return the report."""
        if commands.ndim == 1:
            set_row(self.memory, self.commands[0], commands)
        else:
            for row, values in zip(self.commands, commands.T, strict=True):
                set_row(self.memory, row, values)
        return self._run(self.memory, self.numbers, False)[:, : self.count]

    def report(self) -> np.ndarray:
        """The report of the last step, without a step."""
        reported = self.memory[:, : self.reported].transpose(1, 0, 2)
        return reported.reshape(self.reported, -1)[:, : self.count].copy()

    def _run(self, memory: np.ndarray, numbers: np.ndarray, begin: bool) -> np.ndarray:
        blocks, _, width = memory.shape
        # A block more than there are: rows that lie a power of two apart would drive one another out of the cache.
        out = np.empty((self.reported, blocks + 1, width))
        if blocks < THREADED_BLOCKS:
            self.advance(0, blocks, memory, numbers, out, begin)
        else:
            worker_threads().run(self._advance_in_parts, blocks, memory, numbers, out, begin)
        return out.reshape(self.reported, -1)


def machine_code_of(step: Callable) -> tuple[Callable, CompiledOrPython]:
    """The step of a plant's class for `PlantCopies.machine_code`, from a plain function."""
    return _machine_code_of(step, is_interpreting())


@cache
def _machine_code_of(step: Callable, interpreting: bool) -> tuple[Callable, CompiledOrPython]:
    inlined(step)
    fingerprint = function_fingerprint(step, within=step.__module__)

    def advance(first, last, memory, numbers, out, begin):
        fingerprint  # noqa: B018 - part of the cache's key
        step(first, last, memory, numbers, out, begin)

    return compiled(advance), in_parts(step)


BLOCK = 4  # normals of one draw


@inlined
def add_noise(memory, b, numbers, size, first, root, stream, scratch):
    """Add w ~ N(0, L L') to rows first ... first + size - 1 of every copy.

    The lower triangular L (size, size) lies at numbers[root], by rows; its zeros cost nothing. The draws are those
    of `thruster_env.model.simulate` with the same keys; `stream` is the purpose of the noise, from
    `thruster_env.core.streams`. For initial states the row STEP must be 0. Draws are written into the rows from
    `scratch` on, `size` rounded up to a multiple of BLOCK.
    """
    for block in range((size + BLOCK - 1) // BLOCK):
        at = scratch + BLOCK * block
        for j in range(memory.shape[2]):
            w = normal_block(block, memory[b, STEP, j], stream, memory[b, KEY_0, j], memory[b, KEY_1, j])
            memory[b, at, j], memory[b, at + 1, j], memory[b, at + 2, j], memory[b, at + 3, j] = w
    for i in range(size):
        for k in range(i + 1):
            factor = numbers[root + i * size + k]
            if factor != 0.0:
                for j in range(memory.shape[2]):
                    memory[b, first + i, j] += factor * memory[b, scratch + k, j]


# Channels: a sensor's measurement of a plant, defined once for the plant's step and for a filter's model.


class Channel(NamedTuple):
    """A measured quantity h(x, y, u, c): of the state x, the plant's outputs y at x, its input u and constants c.

    The functions work on tuples of components (floats or arrays) and can be compiled. A channel that does not
    depend on u has slopes: the state alone predicts it, so that a state-space model may contain it.

    Attributes:
        quantity: the measured quantity, with its unit.
        variance: default variance of the channel's Gaussian noise [unit^2].
        code: unique integer that identifies the channel in compiled code; it never changes, so the order of
            channels has no meaning.
        read: h(x, y, u, c).
        slopes: `slopes(x, dy, c)`, the n derivatives dh/dx, where row i of dy is the gradient of output i; None if
            the channel depends on the input.
        affine: whether h is affine in x and y, so that a linear plant's model can have it.
    """

    quantity: Quantity
    variance: float
    code: int
    read: Callable
    slopes: Callable | None = None
    affine: bool = True


def reader_of(channels: Sequence[Channel], of_copy: Callable[[Callable], Callable], arguments: str) -> Callable:
    """Return `read(code, *arguments)`, which reads the channel of a code for one copy of a plant.

    Args:
        channels: data for compiled code.
        of_copy: `of_copy(read)` makes a function of the arguments that finds the inputs of a channel's `read` in a
            copy, and reads it; so compiled code computes only what this channel needs.
        arguments: their names, "memory, b, j".

    Raises:
        ValueError: if two channels have one code.
    """
    codes = sorted(channel.code for channel in channels)
    if len(set(codes)) < len(codes):
        raise ValueError(f"codes of channels must differ from one another, but got {codes}")
    functions: dict[str, Any] = {
        f"read_{channel.code}": inlined(of_copy(inlined(channel.read))) for channel in channels
    }
    source = f"read_{codes[0]}({arguments})"
    for code in codes[1:]:
        source = f"read_{code}({arguments}) if code == {code} else {source}"
    return written_out("read", f"code, {arguments}", source, **functions)


def functions_of(
    channels: Sequence[Channel], outputs: Callable, outputs_jacobian: Callable, states: int
) -> tuple[Callable, Callable]:
    """`observe(x, c)` of a model that has these channels, and its Jacobian by rows.

    Args:
        channels: the measured channels, in order; each with slopes.
        outputs: `outputs(x, c)`, the plant's outputs y.
        outputs_jacobian: `outputs_jacobian(x, c)`, their derivatives by rows.
        states: number of components of x.

    Raises:
        ValueError: if a channel depends on the input.
    """
    reads: dict[str, Any] = {f"read_{i}": inlined(channel.read) for i, channel in enumerate(channels)}
    slopes: dict[str, Any] = {}
    for i, channel in enumerate(channels):
        if channel.slopes is None:
            raise ValueError(
                f"a channel of a model must not depend on the input, but {channel.quantity.name} does"
            )
        slopes[f"slopes_{i}"] = inlined(channel.slopes)
    readings = tuple_of(f"{name}(x, y, (), c)" for name in reads)
    rows = tuple_of(f"{name}(x, dy, c)" for name in slopes)
    observe = written_out("observe", "x, c", "y = outputs(x, c)", readings, outputs=outputs, **reads)
    jacobian = written_out(
        "observe_jacobian", "x, c", "dy = slopes(x, c)", rows, slopes=outputs_jacobian, **slopes
    )
    count = len(channels)
    return as_array(observe, "x, c", count), as_array(jacobian, "x, c", count, states)
