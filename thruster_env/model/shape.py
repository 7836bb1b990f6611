"""Shape and functions of a model, for which code is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from thruster_env.core import matrices
from thruster_env.core.angles import kept
from thruster_env.core.derivatives import jacobian
from thruster_env.core.equal_functions import first_equal

MOST_CONSTANTS = 96  # in a tuple that compiled functions pass on


class Shape(NamedTuple):
    """Sizes of a model, and other data needed to compile its code."""

    n: int  # states
    m: int  # measurements
    inputs: int
    form: type | int  # of the constants: their NamedTuple class, or how many
    state_angles: tuple[bool, ...]  # (n,), which states wrap at 2 pi
    measurement_angles: tuple[bool, ...]  # (m,), which measurements do
    step_ratio: bool = False  # whether the last input is one, by which pages multiply Q: `steps.in_any_steps`

    @property
    def constants(self) -> int:
        """Number of the model's constants."""
        return self.form if isinstance(self.form, int) else len(getattr(self.form, "_fields", ()))


class Functions(NamedTuple):
    """The functions of a model, as `StateSpaceModel` describes them; Jacobians that are unknown are None."""

    transition: Callable
    transition_jacobian: Callable | None
    observe: Callable
    observe_jacobian: Callable | None


def innovation_of(shape: Shape, first: int = 0) -> Callable:
    """Return `subtract(z, y)`: z - y[first:], angles wrapped, zero in channels that are NaN in z."""
    return kept(matrices.innovation(shape.m, first), "z, y", shape.measurement_angles)


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
    """Return `slopes(x, scales, c)`: dh/dx, (m, n)."""
    h, analytic = functions.observe, functions.observe_jacobian
    return jacobian(h, analytic, shape.m, shape.n, "c", shape.measurement_angles)
