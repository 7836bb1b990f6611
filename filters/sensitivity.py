"""Log-likelihood of innovations and scores on true states, with gradients and Fisher information.

`likelihood` and `state_score` have gradients along Q and R, by sensitivities of the filter; `sensitivity` has
gradient and information along parameters that move all numbers of a model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.differentiated.recursion import LOG_SCORE, SQUARES, Wanted
from filters.differentiated.runs import Density, ModelSlopes, Truth, derivatives
from filters.filter import Filter
from filters.starts import Starts
from thruster_env.core.checks import as_floats, one_of
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
        q_slopes: dQ/dparameter, (parameters, n, n), symmetric; (parameters, t, t) if the state has rotations.
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
    n, m, p = model.t, model.m, len(q_slopes)
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


class Sensitivity(NamedTuple):
    """Log-likelihood of the innovations of B trajectories, its slopes along p parameters and their information."""

    values: np.ndarray  # (B,)
    gradients: np.ndarray  # (B, p)
    information: np.ndarray  # (B, p, p), Fisher's, as if the innovations had the covariances S
    block_gradients: np.ndarray  # (B, blocks, p), of the parts of each trajectory
    block_values: np.ndarray  # (B, blocks)


def sensitivity(
    model: StateSpaceModel,
    inputs: np.ndarray,
    measurements: np.ndarray,
    slopes: ModelSlopes,
    *,
    degrees: float = math.inf,
    blocks: int = 1,
    predicted: Sequence[bool] | None = None,
    starts: Starts | None = None,
    filter: Filter | None = None,
    own_slopes: np.ndarray | None = None,
) -> Sensitivity:
    """`likelihood`, and Fisher's information, for parameters that move all numbers of a model.

    Along a parameter the constants move by dc, and with them f, h and their Jacobians: exactly, where the model's
    functions can be traced, else by central differences, whose steps are relative to |c| + |dc|. So a unit of a
    parameter should be a sensible amount of it, as a hundredth of its range or the unit of its logarithm.

    Args:
        model: the model at which slopes are taken.
        inputs: (B, K, p).
        measurements: (B, K + 1, m); NaN where missing.
        slopes: how the model changes along each parameter.
        degrees: degrees of freedom of a Student-t density with the covariance S in place of the normal one, which
            outliers move less; above 2. The filter stays as it is.
        blocks: number of equal parts of each trajectory, whose values and gradients are returned separately.
        predicted: (m,) which channels the filter only predicts, after it has seen the others, and is never updated
            with: such as a load cell that is there for the identification only. Their prediction errors have the
            covariance R, not S: the R of such a channel is that of its whole error. As nothing corrects them, they
            are correlated in time, and the information is overestimated.
        starts: of trajectories that do not begin at the prior: parameters do not move their priors (unless these
            are not held), and the innovations of their lead-ins do not count. The likelihood is that of the other
            measurements, given the lead-ins.
        filter: as `likelihood` takes it; the (extended) Kalman filter by default.
        own_slopes: as `likelihood` takes them.

    Raises:
        ValueError: if shapes do not fit, degrees are not above 2, or for another filter.

    Source: Gupta, Mehra (1974), as `likelihood`; Astrom (1980), "Maximum likelihood and prediction error methods",
    Automatica 16(5), for the information.
    """
    if not degrees > 2:
        raise ValueError(f"degrees of freedom must be above 2, but got {degrees!r}")
    inputs, measurements = (np.ascontiguousarray(as_floats(a)) for a in (inputs, measurements))
    slopes = ModelSlopes(*(np.ascontiguousarray(slope, dtype=np.float64) for slope in slopes))
    n, t, m, p = model.n, model.t, model.m, len(slopes.constants)
    arrays = {"inputs": inputs, "measurements": measurements, **slopes._asdict()}
    check_shapes(arrays, model, (p, len(model.constants)), (p, t, t), (p, m, m), (p, n), (p, t, t))
    counts = 1.0 - np.array(np.zeros(m) if predicted is None else predicted, dtype=np.float64)
    if counts.shape != (m,):
        raise ValueError(f"predicted must be true or false for each of {m} channels, but got {predicted!r}")
    wanted = Wanted(information=True, constants=True, tails=True)
    density = Density(float(degrees), counts)
    out, information = derivatives(
        *(model, inputs, measurements, slopes, wanted),
        density=density,
        blocks=blocks,
        starts=starts,
        used=filter,
        own_slopes=own_slopes,
    )
    total = out.sum(axis=1)
    return Sensitivity(total[:, 0], total[:, 1:], information, out[:, :, 1:], out[:, :, 0])


def state_score(
    model: StateSpaceModel,
    inputs: np.ndarray,
    measurements: np.ndarray,
    states: np.ndarray,
    q_slopes,
    r_slopes,
    score: str = LOG_SCORE,
    weights: Sequence[float] | np.ndarray | None = None,
    filter: Filter | None = None,
    own_slopes: np.ndarray | None = None,
) -> Likelihood:
    """A score of a filter's estimate at the true states, larger is better, and its gradient.

        log-score:  sum_k log N(x; m, P)
        squares:    -sum_k e' W e,  e = x - m,  W = diag(weights)

    with the mean m and covariance P after each update. The gradient is that of `filters.sensitivity.likelihood`'s
    recursion: dm and dP of each parameter, here after the update.

    Args:
        model: holds Q and R, at which the gradient is taken.
        inputs: (B, K, p).
        measurements: (B, K + 1, m); NaN where missing.
        states: (B, K + 1, n), the true ones; NaN where they do not count.
        q_slopes: dQ/dparameter, (parameters, n, n), symmetric.
        r_slopes: dR/dparameter, (parameters, m, m), symmetric.
        score: "log-score" or "squares".
        weights: of the squares, (n,), one by default; those of a log score are one. With rotations (t,): the
            error is the d with move(m, d) = x of `thruster_env.model.turns`.
        filter: as `filters.sensitivity.likelihood` takes it; the (extended) Kalman filter by default.
        own_slopes: as `filters.sensitivity.likelihood` takes them.

    Raises:
        ValueError: if shapes do not fit, or for another score or filter.

    Source: Abbeel, Coates, Montemerlo, Ng, Thrun (2005), "Discriminative training of Kalman filters", Robotics:
    Science and Systems, criteria (ii) and (iii); here with exact gradients.
    """
    one_of("score", score, (LOG_SCORE, SQUARES))
    arrays = (inputs, measurements, states, q_slopes, r_slopes)
    inputs, measurements, states, q_slopes, r_slopes = (np.ascontiguousarray(as_floats(a)) for a in arrays)
    n, t, m, p = model.n, model.t, model.m, len(q_slopes)
    sequences = {"inputs": inputs, "measurements": measurements, "states": states}
    wanted_shapes = (*measurements.shape[:2], n), (p, t, t), (p, m, m)
    check_shapes({**sequences, "q_slopes": q_slopes, "r_slopes": r_slopes}, model, *wanted_shapes)
    of_squares = np.ones(t) if weights is None else as_floats(weights)
    if of_squares.shape != (t,):
        raise ValueError(f"weights must have the shape ({t},), but got {of_squares.shape}")
    slopes = ModelSlopes.of(model, p, process_noise_cov=q_slopes, measurement_noise_cov=r_slopes)
    wanted = Wanted(information=False, constants=False, tails=False, score=score)
    truth, arguments = Truth(states, of_squares), (model, inputs, measurements, slopes, wanted)
    out, _ = derivatives(*arguments, truth=truth, used=filter, own_slopes=own_slopes)
    return Likelihood(out[:, 0, 0], out[:, 0, 1:])
