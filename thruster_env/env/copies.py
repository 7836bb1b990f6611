"""Many copies of a plant, stepped in place in one call of compiled code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import covariance_root
from thruster_env.core.checks import options as checked_options
from thruster_env.core.compiled import inlined, is_interpreting
from thruster_env.core.memory import KEY_0, KEY_1, gathered, new_memory, scatter, set_row
from thruster_env.core.results import as_array
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.env.page import LANES, compiled_page, packed, programs_of
from thruster_env.env.plant_data import checked_state
from thruster_env.graphs.graphs import where
from thruster_env.graphs.values import built, shape_of
from thruster_env.model.quantities import Quantity

PICKLED = ("page_of", "plant", "task", "count", "memory")


class PlantCopies:
    """N copies of a plant with a task, each with its own key; a report of them is an array (reported, N).

    Attributes:
        report_rows: the row or rows of a report by name.
        reported: the row after the last one that a step reports.
        commands: rows of the memory that hold the inputs of the next step.
    """

    def __init__(self, page_of: Callable, plant: Any, task: Any, count: int):
        """Allocate the memory of `count` copies; call `begin` next.

        Args:
            page_of: `page_of(plant, task)` returns the `Page` and its parameters, a named tuple with the sample
                time `dt`, and `prior_mean` and `prior_root` of the initial state.
            plant: the plant.
            task: its task.
            count: number of copies.
        """
        self.page_of, self.plant, self.task, self.count = page_of, plant, task, count
        rows = self._find_machine_code()
        self.memory = new_memory(count, rows, self._lanes)

    def _find_machine_code(self) -> int:
        """Find the programs and their machine code; return the rows of a copy."""
        page, parameters = self.page_of(self.plant, self.task)
        shape = shape_of(parameters)
        programs = programs_of(page, shape)
        self.parameters, self.numbers = parameters, packed(parameters)
        self.report_rows, self.reported = programs.report, programs.reported
        self.commands, self.lines = programs.action, programs.lines
        self.advance = compiled_page(page, shape, self.count == 1, is_interpreting())
        return programs.rows

    @property
    def _lanes(self) -> int:
        return 1 if self.count == 1 else LANES

    def numbers_from(self, options: Mapping | None) -> np.ndarray | None:
        """Numbers for `begin` with the initial state that a reset's options fix in "state", or None.

        Raises ValueError for other options.
        """
        start = checked_options(options).get("state")
        if start is None:
            return None
        p = self.parameters
        state = checked_state("the state of options", start, len(p.prior_mean))
        root = built(shape_of(p.prior_root), repeat(0.0))
        return packed(p._replace(prior_mean=tuple(state), prior_root=root))

    def __getstate__(self) -> dict:
        """All but the page and its machine code, which every process finds for itself."""
        return {name: getattr(self, name) for name in PICKLED}

    def __setstate__(self, state: dict) -> None:
        """Find the machine code for the restored memory; ValueError for the memory of another version."""
        if state.keys() != set(PICKLED):
            raise ValueError("copies of a plant must be pickled by this version, but these are from an older one")
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
        memory = self.memory if which is None else gathered(self.memory, which, self._lanes)
        set_row(memory, KEY_0, keys[:, 0])
        set_row(memory, KEY_1, keys[:, 1])
        out = np.empty(self._shape(memory))
        self._advance(memory, numbers, True)(out)
        if which is not None:
            scatter(memory, self.memory, which)
        return out.reshape(self.reported, -1)[:, : len(keys)]

    def step(self, commands: np.ndarray) -> np.ndarray:
        """Apply commands (N,) of one input, or (N, p), for one sample time; return the report."""
        if commands.ndim == 1:
            set_row(self.memory, self.commands[0], commands)
        else:
            for row, values in zip(self.commands, commands.T, strict=True):
                set_row(self.memory, row, values)
        out = np.empty(self._shape(self.memory))
        self._step(out)
        return out.reshape(self.reported, -1)[:, : self.count]

    def report(self) -> np.ndarray:
        """The report of the last step, without a step."""
        reported = self.memory[:, : self.reported].transpose(1, 0, 2)
        return reported.reshape(self.reported, -1)[:, : self.count].copy()

    def step_into(self, out: np.ndarray) -> Callable[[], Any]:
        """`step()` of a single copy whose episode has begun; its report is put into out (reported, 1, 1)."""
        return self.advance.on_result((self.memory, self.numbers, self.lines, False), out)

    def _shape(self, memory: np.ndarray) -> tuple[int, int, int]:
        """Shape of a report by blocks.

        It has a block more than there are: rows that lie a power of two apart would drive one another out of the
        cache.
        """
        blocks, _, width = memory.shape
        return self.reported, blocks + 1, width

    def _advance(self, memory: np.ndarray, numbers: np.ndarray, begin: bool) -> Callable[[np.ndarray], Any]:
        return self.advance.on(len(memory), (memory, numbers, self.lines, begin), self._shape(memory))

    @cached_property
    def _step(self) -> Callable[[np.ndarray], Any]:
        return self._advance(self.memory, self.numbers, False)


# What pages are written with.


def root_of(cov: np.ndarray) -> tuple[tuple[float | None, ...], ...]:
    """The lower triangular root of a covariance by rows; None for zeros, with which nothing is computed."""
    root = covariance_root(cov)
    return tuple(tuple(value or None for value in row[: i + 1]) for i, row in enumerate(root.tolist()))


def correlated(root: Sequence[Sequence], draws: Sequence) -> list:
    """L w of a root L from `root_of` and independent draws w."""
    rows = ([a * b for a, b in zip(row, draws, strict=False) if a is not None] for row in root)
    return [sum(terms[1:], terms[0]) if terms else 0.0 for terms in rows]


def clipped(value, low, high):
    """A number within low ... high."""
    value = where(value < low, low, value)
    return where(value > high, high, value)


# Channels: a sensor's measurement of a plant, defined once for the plant's step and for a filter's model.


class Channel(NamedTuple):
    """A measured quantity h(x, y, u, c): of the state x, the plant's outputs y at x, its input u and constants c.

    The functions work on tuples of components (floats or arrays) and can be compiled. A channel that does not
    depend on u has slopes: the state alone predicts it, so that a state-space model may contain it.

    Attributes:
        quantity: the measured quantity, with its unit.
        variance: default variance of the channel's Gaussian noise [unit^2].
        read: h(x, y, u, c).
        slopes: `slopes(x, dy, c)`, the n derivatives dh/dx, where row i of dy is the gradient of output i; None if
            the channel depends on the input.
        affine: whether h is affine in x and y, so that a linear plant's model can have it.
    """

    quantity: Quantity
    variance: float
    read: Callable
    slopes: Callable | None = None
    affine: bool = True


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
