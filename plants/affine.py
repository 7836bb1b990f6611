"""Affine models x' = A x + B u + a, z = C x + d, and affine approximations of nonlinear ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from numerics.checks import covariance, vector
from numerics.derivatives import jacobian
from numerics.pickling import makes_functions
from numerics.tuples import tuple_of, written_out
from plants.shape import observation_slopes, transition_slopes
from plants.state_space import StateSpaceModel


@makes_functions
def affine_functions(n: int, m: int, p: int) -> dict[str, Callable]:
    """Functions of an affine model whose constants c are, by rows and in this order, A, B, a, C, d."""
    places = iter(range(n * (n + p + 1) + m * (n + 1)))
    a, b, offset, c, shift = (
        [[f"c[{next(places)}]" for _ in range(columns)] for _ in range(rows)]
        for rows, columns in ((n, n), (n, p), (n, 1), (m, n), (m, 1))
    )

    def sums(matrix, vector):
        return [" + ".join(f"{entry} * {vector}[{j}]" for j, entry in enumerate(row)) or "0.0" for row in matrix]

    state = [f"{x} + {u} + {k[0]}" for x, u, k in zip(sums(a, "x"), sums(b, "u"), offset, strict=True)]
    output = [f"{x} + {k[0]}" for x, k in zip(sums(c, "x"), shift, strict=True)]
    return {
        "transition": written_out("transition", "x, u, c", tuple_of(state)),
        "observe": written_out("observe", "x, c", tuple_of(output)),
        "transition_jacobian": written_out("transition_jacobian", "x, u, c", tuple_of(map(tuple_of, a))),
        "observe_jacobian": written_out("observe_jacobian", "x, c", tuple_of(map(tuple_of, c))),
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class AffineModel(StateSpaceModel):
    """A `StateSpaceModel` with f(x, u) = A x + B u + a and h(x) = C x + d; make it with `affine_model`."""

    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """A (n, n), B (n, p), a (n,), C (m, n), d (m,)."""
        n, m, p = self.n, self.m, self.inputs
        parts = np.split(np.array(self.constants), np.cumsum([n * n, n * p, n, m * n]))
        return parts[0].reshape(n, n), parts[1].reshape(n, p), parts[2], parts[3].reshape(m, n), parts[4]


def affine_model(
    *,
    a,
    b,
    c,
    process_noise_cov,
    measurement_noise_cov,
    prior_mean,
    prior_cov,
    state_offset=None,
    measurement_offset=None,
    states=None,
    input_quantities=None,
    measurements=None,
) -> AffineModel:
    """The model x' = A x + B u + state_offset + w, z = C x + measurement_offset + v.

    Args:
        a: A, (n, n).
        b: B, (n, p).
        c: C, (m, n).
        process_noise_cov: Q, (n, n) or n variances.
        measurement_noise_cov: R, (m, m) or m variances.
        prior_mean: (n,).
        prior_cov: (n, n) or n variances.
        state_offset: (n,), zero if None.
        measurement_offset: (m,), zero if None.
        states: names of the states, as `StateSpaceModel` takes them; so ...
        input_quantities: ... those of inputs ...
        measurements: ... and measurements.

    Raises:
        ValueError: if shapes do not fit.
    """
    a, b, c = (np.atleast_2d(np.array(value, dtype=np.float64)) for value in (a, b, c))
    n, m, p = len(a), len(c), b.shape[1]
    if a.shape != (n, n) or b.shape != (n, p) or c.shape != (m, n):
        raise ValueError(
            f"a, b, c must have shapes (n, n), (n, p), (m, n), but got {a.shape}, {b.shape}, {c.shape}"
        )
    offset = vector("state_offset", [0.0] * n if state_offset is None else state_offset, n)
    shift = vector("measurement_offset", [0.0] * m if measurement_offset is None else measurement_offset, m)
    prior_mean = vector("prior_mean", prior_mean, n)
    measurement_noise_cov = covariance("measurement_noise_cov", measurement_noise_cov, m)
    return AffineModel(
        **affine_functions(n, m, p),
        process_noise_cov=process_noise_cov,
        measurement_noise_cov=measurement_noise_cov,
        prior_mean=prior_mean,
        prior_cov=prior_cov,
        inputs=p,
        constants=tuple(float(v) for part in (a, b, offset, c, shift) for v in np.ravel(part)),
        states=states,
        input_quantities=input_quantities,
        measurements=measurements,
    )


@cache
def _input_first(transition: Callable) -> Callable:
    return lambda u, x, c: transition(x, u, c)


def linearize(model: StateSpaceModel, state: Any, control: Any) -> AffineModel:
    """Affine approximation of a model about a state x* (n,) and an input u* (p,), offsets kept.

    x' = f(x*, u*) + A (x - x*) + B (u - u*),  z = h(x*) + C (x - x*). An affine model comes back as it is.
    """
    if isinstance(model, AffineModel):
        return model
    x, u, c = np.array(state, dtype=np.float64), np.array(control, dtype=np.float64), model.constants
    n, p = model.n, model.inputs
    a, b, point, v = np.eye(n), np.zeros((n, p)), tuple(x), tuple(u)
    scales, input_scales = tuple(model.scales), tuple(np.where(u == 0, 1.0, np.abs(u)))
    step = transition_slopes(model.functions, model.shape)
    by_input = jacobian(_input_first(model.transition), None, n, p, "state, c", model.shape.state_angles)
    for _ in range(model.substeps):
        f = np.array(step(point, scales, v, c))
        a, b = f @ a, f @ b + np.array(by_input(v, input_scales, point, c)).reshape(n, p)
        point = model.transition(point, v, c)
    h = np.array(observation_slopes(model.functions, model.shape)(tuple(x), scales, c))
    return affine_model(
        a=a,
        b=b,
        c=h,
        state_offset=np.array(point) - a @ x - b @ u,
        measurement_offset=np.array(model.observe(tuple(x), c)) - h @ x,
        process_noise_cov=model.process_noise_cov,
        measurement_noise_cov=model.measurement_noise_cov,
        prior_mean=model.prior_mean,
        prior_cov=model.prior_cov,
        **model.quantities._asdict(),
    ).replace(state_low=model.state_low, state_high=model.state_high)
