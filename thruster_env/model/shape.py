"""Shape and functions of a model, for which code is compiled, and the places of its numbers in a row."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import covariance_root
from thruster_env.core.derivatives import jacobian
from thruster_env.core.equal_functions import first_equal
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.model.turns import Turn

MOST_CONSTANTS = 96  # in a tuple that compiled functions pass on


class Shape(NamedTuple):
    """Sizes of a model, and other data needed to compile its code."""

    n: int  # states, as they are stored
    m: int  # measurements: components of an innovation
    inputs: int
    form: type | int  # of the constants: their NamedTuple class, or how many
    state_angles: tuple[bool, ...]  # (n,), which states wrap at 2 pi
    measurement_angles: tuple[bool, ...]  # (channels,), which measurements do
    step_ratio: bool = False  # whether the last input is one, by which pages multiply Q: `steps.in_any_steps`
    feeds: bool = False  # whether h takes the input: h(x, u, c)
    turns: tuple[Turn, ...] = ()  # rotations among the states, whose errors have fewer components
    measured_turns: tuple[Turn, ...] = ()  # those among the measurements

    @property
    def t(self) -> int:
        """Number of components of an error of the state, and so rows of P and Q."""
        return self.n - len(self.turns)

    @property
    def channels(self) -> int:
        """Number of stored numbers of a measurement: m, and one for each rotation."""
        return self.m + len(self.measured_turns)

    @property
    def offsets(self) -> NumberOffsets:
        """Places of the parts of a model's row."""
        return number_offsets(self.n, self.m, self.t)

    @property
    def constants(self) -> int:
        """Number of the model's constants."""
        return self.form if isinstance(self.form, int) else len(getattr(self.form, "_fields", ()))

    @property
    def feed(self) -> int:
        """Number of inputs that h takes: all, or none."""
        return self.inputs if self.feeds else 0

    def fed(self, u: Any) -> tuple:
        """The arguments of h between x and the constants: the input u, or none."""
        return (u,) if self.feeds else ()

    @property
    def observe_arguments(self) -> str:
        """Those of h besides x."""
        return "u, c" if self.feeds else "c"


class Functions(NamedTuple):
    """The functions of a model, as `StateSpaceModel` describes them; Jacobians that are unknown are None."""

    transition: Callable
    transition_jacobian: Callable | None
    observe: Callable
    observe_jacobian: Callable | None


def constants_form(constants: tuple) -> type | int:
    """The description of a model's constants in a `Shape`."""
    return first_equal(type(constants)) if hasattr(constants, "_fields") else len(constants)


def constants_are_array(form: type | int) -> bool:
    """Whether functions get the constants as an array."""
    return isinstance(form, int) and form > MOST_CONSTANTS


def transition_slopes(functions: Functions, shape: Shape) -> Callable:
    """Return `slopes(x, scales, u, c)`: df/dx of one substep, (n, n), by `thruster_env.core.derivatives`."""
    f, analytic, n = functions.transition, functions.transition_jacobian, shape.n
    return jacobian(f, analytic, n, n, "u, c", shape.state_angles)


def observation_slopes(functions: Functions, shape: Shape) -> Callable:
    """Return `slopes(x, scales, c)`, or of an h with input `slopes(x, scales, u, c)`: dh/dx, (channels, n)."""
    h, analytic = functions.observe, functions.observe_jacobian
    return jacobian(h, analytic, shape.channels, shape.n, shape.observe_arguments, shape.measurement_angles)


@lru_cache(maxsize=64)
def for_any_input(function: Callable, shape: Shape, arguments: str = "x") -> Callable:
    """The function h of (x, u, c), or its slopes (x, scales, u, c), whether it takes the input or not."""
    if shape.feeds:
        return function
    lines = f"function({arguments}, c)"
    return written_out("seen", f"{arguments}, u, c", lines, function=function)


LANES = 8  # float64 in the widest vector register: ensembles are padded, so that loops have no remainder


def padded(size, lanes):
    """The smallest multiple of `lanes` that is at least `size`."""
    return (size + lanes - 1) // lanes * lanes


class NumberOffsets(NamedTuple):
    """First places of the parts of a model's row, for n states, m measurements and errors with t components."""

    q: int  # (t, t), process noise covariance
    q_root: int  # (t, t), lower triangular, q_root q_root' = q
    r: int  # (m, m), measurement noise covariance
    r_root: int  # (m, m)
    prior_mean: int  # (n,)
    prior_cov: int  # (t, t)
    prior_root: int  # (t, t)
    scales: int  # (n,), what small steps of each state are measured in
    substeps: int
    constants: int  # the model's own constants; a filter's own numbers follow


@cache
def number_offsets(n: int, m: int, t: int | None = None) -> NumberOffsets:
    """Places in the row of a model's numbers, see `StateSpaceModel.numbers`; t = n if None."""
    tt = n * n if t is None else t * t
    return NumberOffsets(*starts_of(tt, tt, m * m, m * m, n, tt, tt, n, 1))


def with_root(cov: np.ndarray) -> np.ndarray:
    """A covariance (d, d) followed by its lower triangular root, as in a model's row."""
    return np.concatenate([cov.ravel(), covariance_root(cov).ravel()])


def starts_of(*lengths: int) -> list[int]:
    """First places of consecutive parts, and the end of the last one."""
    return [0, *np.cumsum(lengths).tolist()]


@lru_cache(maxsize=64)
def constants_reader(shape: Shape) -> Callable:
    """Return `read(numbers)`: the model's constants as its functions take them."""
    start = shape.offsets.constants
    if constants_are_array(shape.form):
        return written_out("read", "row", f"row[{start}:{start + shape.constants}]")
    values = [f"row[{start + i}]" for i in range(shape.constants)]
    if isinstance(shape.form, int):
        return written_out("read", "row", tuple_of(values))
    return written_out("read", "row", f"Constants({', '.join(values)})", Constants=shape.form)
