"""The log-likelihood of innovations and its gradient with respect to Q and R, by sensitivities of the filter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from filters.differentiated.recursion import Wanted
from filters.differentiated.runs import ModelSlopes, derivatives
from filters.filter import Filter
from thruster_env.core.checks import as_floats
from thruster_env.model.state_space import StateSpaceModel


class Likelihood(NamedTuple):
    """Log-likelihood of the innovations of B trajectories, and its slopes along p parameters."""

    values: np.ndarray  # (B,)
    gradients: np.ndarray  # (B, p)


def likelihood(
    model: StateSpaceModel,
    inputs: np.ndarray,
    measurements: np.ndarray,
    q_slopes,
    r_slopes,
    filter: Filter | None = None,
    own_slopes: np.ndarray | None = None,
) -> Likelihood:
    """Log-likelihood of a filter's innovations, by default the (extended) Kalman filter's, with its gradient.

        log L = -1/2 sum_k (v' S^-1 v + log det 2 pi S),  v = z - h(m),  S = H P H' + R

    or with the v and S of another filter. Beside mean m and covariance P the recursion carries dm and dP for each
    parameter: the derivative of every equation of the filter (`filters.pages`). Terms that all parameters share
    are computed once a step. Sigma-point filters carry the slope of P's root, too; it is NaN where P is singular
    and a parameter makes it regular.
    F = df/dx and H = dh/dx depend on the parameters through m. Their derivatives along dm are exact if the
    functions can be traced (arithmetic with a few branches); else they are central differences of the model's
    Jacobians, of large models along each component of x.

    Args:
        model: holds Q and R, at which the gradient is taken.
        inputs: (B, K, p).
        measurements: (B, K + 1, m); NaN where missing.
        q_slopes: dQ/dparameter, (parameters, n, n), symmetric.
        r_slopes: dR/dparameter, (parameters, m, m), symmetric.
        filter: one of `differentiated.runs.KINDS`, or your own; its model is replaced by `model`.
        own_slopes: slopes of the filter's `own_parameters`, (parameters, count); zero if None.

    Raises:
        ValueError: if shapes do not fit, or for another filter.

    Source: Gupta, Mehra (1974), "Computational aspects of maximum likelihood estimation and reduction in
    sensitivity function calculations", IEEE Trans. Automatic Control 19(6).
    """
    out, _ = _derivatives(model, (inputs, measurements, q_slopes, r_slopes), False, filter, own_slopes)
    return Likelihood(out[:, 0], out[:, 1:])


def information(
    model: StateSpaceModel,
    inputs: np.ndarray,
    measurements: np.ndarray,
    q_slopes,
    r_slopes,
    filter: Filter | None = None,
) -> np.ndarray:
    """Fisher's information on p parameters in the innovations of each of B trajectories, (B, p, p).

        I_ij = sum_k dv_i' S^-1 dv_j + 1/2 tr(S^-1 dS_i S^-1 dS_j)

    with v and S of the filter along that trajectory: the expectation of minus the second derivatives of log L
    where the model is right. Arguments and errors are those of `likelihood`, and the cost is about the same.

    Source: Gupta, Mehra (1974), as above.
    """
    _, information = _derivatives(model, (inputs, measurements, q_slopes, r_slopes), True, filter)
    return information


def _derivatives(
    model: StateSpaceModel,
    arguments: tuple,
    informative: bool,
    used: Filter | None,
    own_slopes: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihood with gradient, (B, 1 + p), and the information, (B, p, p), or nothing in its place."""
    inputs, measurements, q_slopes, r_slopes = (np.ascontiguousarray(as_floats(value)) for value in arguments)
    n, m, p = model.n, model.m, len(q_slopes)
    arrays = {"inputs": inputs, "measurements": measurements, "q_slopes": q_slopes, "r_slopes": r_slopes}
    check_shapes(arrays, model, (p, n, n), (p, m, m))
    slopes = ModelSlopes.of(model, p, process_noise_cov=q_slopes, measurement_noise_cov=r_slopes)
    wanted = Wanted(information=informative, constants=False, tails=False)
    out, information = derivatives(model, inputs, measurements, slopes, wanted, used=used, own_slopes=own_slopes)
    return out[:, 0], information


def check_shapes(arrays: dict[str, np.ndarray], model: StateSpaceModel, *of_slopes: tuple[int, ...]) -> None:
    """Raise ValueError unless inputs, measurements and slopes have the shapes that fit the model."""
    shapes = tuple(array.shape for array in arrays.values())
    count, steps = len(arrays["measurements"]), arrays["inputs"].shape[1] if arrays["inputs"].ndim == 3 else 0
    wanted = (count, steps, model.inputs), (count, steps + 1, model.m), *of_slopes
    if shapes != wanted:
        *names, last = arrays
        raise ValueError(f"{', '.join(names)} and {last} must have the shapes {wanted}, but got {shapes}")
