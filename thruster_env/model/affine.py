"""Affine models x' = A x + B u + a, z = C x + D u + d, and affine approximations of nonlinear ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any

import numpy as np

from thruster_env.core.angles import difference
from thruster_env.core.checks import covariance, positive, vector
from thruster_env.core.derivatives import step_growth, step_of
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import Source, as_value
from thruster_env.model.shape import (
    Functions,
    constants_are_array,
    observation_slopes,
    starts_of,
    transition_slopes,
)
from thruster_env.model.state_space import StateSpaceModel


@makes_functions
def affine_functions(n: int, m: int, p: int, feeds: bool = False) -> dict[str, Callable]:
    """Functions of an affine model whose constants c are A, B, a, C, d and, if it feeds, D, matrices by rows."""
    *starts, last = starts_of(n * n, n * p, n, m * n, m)  # of A, B, a, C, d, D
    size = last + feeds * m * p
    sizes = {"x": (n,), "u": (p,), "c": (size,)}
    if constants_are_array(size):
        del sizes["c"]  # whatever its size, it is an array

    def function(name: str, arguments: str, rows: int, matrices: dict, offset: int) -> Callable:
        """The sum of products of matrices, by their first places and columns, with vectors, and of the offset."""
        shapes: dict[str, Any] = {
            argument: sizes[argument] for argument in arguments.split(", ") if argument in sizes
        }
        source = Source(name, arguments, result=(rows,), work=rows * (n + p), **shapes)

        def entry(i):
            terms = (
                source.sum(f"c[{i * columns + j + first}] * {vector}[{j}]" for j in source.range(columns))
                for vector, (first, columns) in matrices.items()
            )
            return " + ".join((*terms, f"c[{i + offset}]"))

        return source.function(source.vector(rows, entry))

    def slopes(name: str, arguments: str, rows: int, first: int) -> Callable:
        shapes: dict[str, Any] = {key: sizes[key] for key in "c" if key in sizes}
        source = Source(name, arguments, result=(rows, n), **shapes)
        return source.function(source.matrix(rows, n, lambda i, j: f"c[{i * n + j + first}]"))

    a, b, state_offset, c, measurement_offset = starts
    fed, terms = ("x, u, c", {"u": (last, p)}) if feeds else ("x, c", {})
    return {
        "transition": function("transition", "x, u, c", n, {"x": (a, n), "u": (b, p)}, state_offset),
        "observe": function("observe", fed, m, {"x": (c, n), **terms}, measurement_offset),
        "transition_jacobian": slopes("transition_jacobian", "x, u, c", n, a),
        "observe_jacobian": slopes("observe_jacobian", fed, m, c),
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class AffineModel(StateSpaceModel):
    """A `StateSpaceModel` with f = A x + B u + a and h = C x + d or C x + D u + d; make it with `affine_model`.

    Attributes:
        dt: sample time [s] that A, B and Q are for; None if it is not known.
    """

    dt: float | None = None

    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """A (n, n), B (n, p), a (n,), C (m, n), d (m,)."""
        n, m, p = self.n, self.m, self.inputs
        parts = np.split(np.array(self.constants), np.cumsum([n * n, n * p, n, m * n, m]))
        return parts[0].reshape(n, n), parts[1].reshape(n, p), parts[2], parts[3].reshape(m, n), parts[4]

    @property
    def feedthrough(self) -> np.ndarray | None:
        """D (m, p) of z = C x + D u + d; None if h does not take the input."""
        size = self.m * self.inputs
        return np.array(self.constants[-size:]).reshape(self.m, self.inputs) if self.feeds and size else None


LETTERS = {
    "A": "a",
    "F": "a",
    "B": "b",
    "G": "b",
    "C": "c",
    "H": "c",
    "D": "d",
    "Q": "process_noise_cov",
    "R": "measurement_noise_cov",
    "x0": "prior_mean",
    "P0": "prior_cov",
}  # by which people know the arguments of `affine_model`


def _by_letters(make: Callable) -> Callable[..., AffineModel]:
    """`affine_model` with the letters of `LETTERS`, too, and defaults for B and the initial state."""

    @wraps(make)
    def with_letters(**arguments: Any) -> AffineModel:
        for letter in LETTERS.keys() & arguments.keys():
            name, value = LETTERS[letter], arguments.pop(letter)
            if name in arguments:
                raise ValueError(f"{name} must be given once, but got {letter}, too")
            arguments[name] = value
        if "a" in arguments:
            size = len(np.atleast_2d(arguments["a"]))
            arguments.setdefault("b", np.zeros((size, 0)))
            arguments.setdefault("prior_mean", np.zeros(size))
        if not np.any(arguments.get("d", 0.0)):
            arguments.pop("d", None)
        return make(**arguments)

    return with_letters


def without_column(value: Any) -> Any:
    """A column (n, 1), as FilterPy and MATLAB have a mean, as (n,); any other value as it is."""
    try:
        array = np.asarray(value)
    except ValueError:  # of a list of different lengths
        return value
    return array[:, 0] if array.ndim == 2 and array.shape[1] == 1 else value


@_by_letters
def affine_model(
    *,
    a,
    b,
    c,
    process_noise_cov,
    measurement_noise_cov,
    prior_mean,
    prior_cov,
    d=None,
    state_offset=None,
    measurement_offset=None,
    states=None,
    input_quantities=None,
    measurements=None,
    dt=None,
) -> AffineModel:
    """Make a model that is linear in state and input, with constant offsets.

        x' = A x + B u + state_offset + w,  w ~ N(0, Q);   z = C x + measurement_offset + v,  v ~ N(0, R)

    With D, z_{k+1} = C x_{k+1} + D u_k + measurement_offset + v, the input until then: see `StateSpaceModel`.
    Covariances are per step and do not scale with dt. Arguments may also be named F or A, B or G, H or C, D, Q, R,
    x0 and P0: `affine_model(F=F, H=H, Q=Q, R=R, P0=P0)`.

    Args:
        a: A, (n, n).
        b: B, (n, p); without inputs by default.
        c: C, (m, n).
        process_noise_cov: Q, (n, n) or n variances.
        measurement_noise_cov: R, (m, m) or m variances.
        prior_mean: mean of the initial state, (n,); zero by default.
        prior_cov: covariance of the initial state, (n, n) or n variances.
        d: D, (m, p); none if None.
        state_offset: (n,), zero if None.
        measurement_offset: (m,), zero if None.
        states: names and units of the states, as `StateSpaceModel` takes them.
        input_quantities: those of the inputs.
        measurements: those of the measurements.
        dt: sample time [s], so that `filters.run` refuses data with other steps; None if it is not known.

    Raises:
        ValueError: if shapes do not fit.
    """
    a, b, c = (np.atleast_2d(np.array(value, dtype=np.float64)) for value in (a, b, c))
    n, m, p = len(a), len(c), b.shape[1]
    if a.shape != (n, n) or b.shape != (n, p) or c.shape != (m, n):
        raise ValueError(
            f"a, b, c must have shapes (n, n), (n, p), (m, n), but got {a.shape}, {b.shape}, {c.shape}"
        )
    if d is not None:
        d = np.atleast_2d(np.array(d, dtype=np.float64))
        if d.shape != (m, p):
            raise ValueError(f"d must have shape (m, p) = {(m, p)}, as c and b say, but got {d.shape}")
    feeds = d is not None and p > 0
    offset = vector("state_offset", [0.0] * n if state_offset is None else state_offset, n)
    shift = vector("measurement_offset", [0.0] * m if measurement_offset is None else measurement_offset, m)
    prior_mean = vector("prior_mean", without_column(prior_mean), n)
    measurement_noise_cov = covariance("measurement_noise_cov", measurement_noise_cov, m)
    return AffineModel(
        **affine_functions(n, m, p, feeds),
        process_noise_cov=process_noise_cov,
        measurement_noise_cov=measurement_noise_cov,
        prior_mean=prior_mean,
        prior_cov=prior_cov,
        inputs=p,
        constants=tuple(float(v) for part in (a, b, offset, c, shift, *([d] * feeds)) for v in np.ravel(part)),
        states=states,
        input_quantities=input_quantities,
        measurements=measurements,
        dt=None if dt is None else positive("dt", dt),
    )


def _slopes_by_input(
    model: StateSpaceModel,
    function: Callable,
    rows: int,
    angles: tuple[bool, ...],
    x: Any,
    scales: Any,
    u: np.ndarray,
) -> np.ndarray:
    """df/du of one application of f, or dh/du, (rows, p), by central differences; a zero input has the scale 1."""
    of_inputs, c = np.where(u == 0, 1.0, np.abs(u)), model.given_constants
    far = step_growth(model.n + model.inputs)((*x, *u), (*scales, *of_inputs))
    columns = np.zeros((model.inputs, rows))
    for j, unit in enumerate(np.eye(model.inputs)):
        h = step_of(float(u[j]), float(of_inputs[j]), far)
        above, below = (function(x, as_value(u + side * unit), c) for side in (h, -h))
        columns[j] = difference(np.array(above), np.array(below), angles) / (2.0 * h)
    return columns.T


def slopes_of_step(
    model: StateSpaceModel,
    x: np.ndarray,
    u: np.ndarray,
    by_input: bool = False,
    functions: Functions | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slopes of a whole step at a state x (n,) and an input u (p,).

    Args:
        model: the model.
        x: the state.
        u: the input.
        by_input: whether df/du is asked for.
        functions: the model's, which take longer to prepare than a step, for callers of many steps.

    Returns:
        df/dx (n, n) and df/du (n, p) over all substeps, the latter zero unless asked for; and f(x, u), (n,).
    """
    a, b, point = np.eye(model.n), np.zeros((model.n, model.inputs)), as_value(x)
    scales, v, c = as_value(model.scales), as_value(u), model.given_constants
    functions = functions or model.functions
    slopes, angles = transition_slopes(functions, model.shape), model.shape.state_angles
    for _ in range(model.substeps):
        f = np.array(slopes(point, scales, v, c)).reshape(a.shape)
        a, b = f @ a, f @ b
        if by_input:
            b = b + _slopes_by_input(model, functions.transition, model.n, angles, point, scales, u)
        point = functions.transition(point, v, c)
    return a, b, np.array(point)


def linearize(model: StateSpaceModel, state: Any, control: Any) -> AffineModel:
    """Linearise a model about a state x* (n,) and an input u* (p,); the offsets are kept.

        x' = f(x*, u*) + A (x - x*) + B (u - u*),   z = h(x*) + C (x - x*)

    with the Jacobians A = df/dx, B = df/du (over all substeps) and C = dh/dx at x*, u*. If h takes the input,
    z = h(x*, u*) + C (x - x*) + D (u - u*) with D = dh/du.

    Args:
        model: the model; an affine one is returned as it is.
        state: x*, (n,), in the units of the states.
        control: u*, (p,), in the units of the inputs.

    Returns:
        The affine model, with the same noise, prior, names and units.
    """
    if isinstance(model, AffineModel):
        return model
    x, u, c = np.array(state, dtype=np.float64), np.array(control, dtype=np.float64), model.given_constants
    a, b, point = slopes_of_step(model, x, u, by_input=True)
    shape, functions, scales = model.shape, model.functions, as_value(model.scales)
    fed = shape.fed(as_value(u))
    h = np.array(observation_slopes(functions, shape)(as_value(x), scales, *fed, c)).reshape(model.m, model.n)
    offset, d = np.array(functions.observe(as_value(x), *fed, c)) - h @ x, None
    if shape.feeds:
        angles = shape.measurement_angles
        d = _slopes_by_input(model, functions.observe, model.m, angles, as_value(x), scales, u)
        offset -= d @ u
    return affine_model(
        a=a,
        b=b,
        c=h,
        d=d,
        state_offset=point - a @ x - b @ u,
        measurement_offset=offset,
        process_noise_cov=model.process_noise_cov,
        measurement_noise_cov=model.measurement_noise_cov,
        prior_mean=model.prior_mean,
        prior_cov=model.prior_cov,
        **model.quantities._asdict(),
    ).replace(
        state_low=model.state_low, state_high=model.state_high, bounds=model.bounds, bounded_by=model.bounded_by
    )
