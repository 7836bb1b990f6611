"""Log-likelihood of innovations and scores on true states, with gradients and Fisher information.

`likelihood` and `state_score` have gradients along Q and R, by sensitivities of the filter; `sensitivity` has
gradient and information along parameters that move all numbers of a model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from filters.adaptive import RobustExtendedKalmanFilter, SageHusaFilter, VariationalBayesFilter
from filters.algebra.points import tail_of
from filters.differentiated import LOG_SCORE, SQUARES, Wanted, recursion_of
from filters.filter import Filter, PageFilter
from filters.gaussian.extended import (
    ExtendedKalmanFilter,
    FadingMemoryFilter,
    HInfinityFilter,
    IteratedExtendedKalmanFilter,
    SchmidtKalmanFilter,
)
from filters.gaussian.kalman import KalmanFilter
from filters.gaussian.sigma_points import CubatureKalmanFilter, UnscentedKalmanFilter
from filters.pages.page import Page
from filters.starts import Starts, as_the_prior_says
from thruster_env.core.angles import wrapped_where
from thruster_env.core.checks import as_floats, one_of
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.parallel import spread
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import of_channels, refuse_rotations

KINDS: tuple[type[PageFilter], ...] = (
    KalmanFilter,
    ExtendedKalmanFilter,
    IteratedExtendedKalmanFilter,
    UnscentedKalmanFilter,
    CubatureKalmanFilter,
    FadingMemoryFilter,
    HInfinityFilter,
    SchmidtKalmanFilter,
    RobustExtendedKalmanFilter,
    SageHusaFilter,
    VariationalBayesFilter,
)
STEP = 1e-6  # of parameters, which are scaled to sensible changes of 1


def has_derivatives(kind: type[Filter]) -> bool:
    """Whether a class of filters has derivatives: one of `KINDS`, or a user's that has a page."""
    kind = kind.of_recursion()
    return kind in KINDS or (not kind.__module__.startswith("filters.") and issubclass(kind, PageFilter))


class Differentiable(NamedTuple):
    """What derivatives are taken of."""

    model: StateSpaceModel  # that the filter runs on
    page: Page
    own: tuple[float, ...]  # the filter's parameters


def differentiable(model: StateSpaceModel, filter_: Filter | None) -> Differentiable:
    """A filter with another model in place of its own; of None the extended Kalman filter.

    Raises:
        ValueError: for a filter without a page, or a value of its own that does not go with the model.
    """
    if filter_ is None:
        return Differentiable(model, ExtendedKalmanFilter.page, ())
    if not isinstance(filter_, Filter):
        raise ValueError(f"filter must be an object that make_filter returns, but got {filter_!r}")
    if not (isinstance(filter_, PageFilter) and has_derivatives(type(filter_))):
        names = ", ".join(kind.name for kind in KINDS)
        raise ValueError(f"a filter with derivatives must be one of {names}, but got {filter_.name!r}")
    if isinstance(filter_, KalmanFilter) and filter_.schedule != 1:
        raise ValueError(f"a filter with derivatives must have schedule=1, but got {filter_.schedule}")
    form = {"form": "covariance"} if filter_.forms else {}  # of the same estimates
    used = replace(filter_, model=model, **form)
    if not used.takes_rotations:
        refuse_rotations(model)
    return Differentiable(used.kernel_model, used.written_page, used.own_parameters)


class ModelSlopes(NamedTuple):
    """Derivatives of a model with respect to p parameters, each scaled so that 1 is a sensible change of it."""

    constants: np.ndarray  # (p, c)
    process_noise_cov: np.ndarray  # (p, n, n), or of the tangent (p, t, t); symmetric
    measurement_noise_cov: np.ndarray  # (p, m, m), symmetric
    prior_mean: np.ndarray  # (p, n)
    prior_cov: np.ndarray  # as Q

    @classmethod
    def of(cls, model: StateSpaceModel, parameters: int, **moving: np.ndarray) -> ModelSlopes:
        """Slopes of parameters that move the named arrays, and nothing else."""
        still = (name for name in cls._fields if name not in moving)
        return cls(**moving, **{name: np.zeros((parameters, *np.shape(getattr(model, name)))) for name in still})

    @classmethod
    def between(cls, pairs: Sequence[tuple[StateSpaceModel, StateSpaceModel]], step: float) -> ModelSlopes:
        """Differences of pairs of models, one for each parameter, over the step between the models of a pair."""
        return cls(
            *(
                np.array([np.subtract(getattr(a, name), getattr(b, name)) / step for a, b in pairs])
                for name in cls._fields
            )
        )


class Density(NamedTuple):
    """The density of innovations: degrees of freedom of Student's t, and which channels (m,) the filter sees."""

    degrees: float
    seen: np.ndarray


class Truth(NamedTuple):
    """True states of B runs, NaN where they do not count, and the weight (n,), or (t,), of each squared error."""

    states: np.ndarray  # (B, K + 1, n)
    weights: np.ndarray


def derivatives(
    model: StateSpaceModel,
    inputs: np.ndarray,
    measurements: np.ndarray,
    slopes: ModelSlopes,
    wanted: Wanted,
    *,
    density: Density | None = None,
    blocks: int = 1,
    starts: Starts | None = None,
    truth: Truth | None = None,
    used: Filter | None = None,
    own_slopes: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Scores and gradients of parts of B runs, (B, blocks, 1 + p), and their information, (B, p, p).

    Arguments are those of `filters.sensitivity.sensitivity`, with shapes already checked. The filter is used with
    the model in place of its own. A parameter may move its `own_parameters` by `own_slopes`, (p, their count).
    An output that is not wanted is empty: (B, 0, 0).
    """
    parameters, given_model, functions = len(slopes.constants), model, model.functions
    model, page, own_parameters = differentiable(model, used)
    if model.functions != functions:  # those of an affine approximation, with constants of its own
        if wanted.constants:
            rule = "slopes along constants must be of a filter of the model itself"
            raise ValueError(f"{rule}, but got 'kf' of another")
        slopes = slopes._replace(constants=np.zeros((parameters, len(model.constants))))
    if own_slopes is None:
        own_slopes = np.zeros((parameters, len(own_parameters)))
    if own_slopes.shape != (parameters, len(own_parameters)):
        rule = f"own_slopes must have the shape {(parameters, len(own_parameters))}"
        raise ValueError(f"{rule}, but got {own_slopes.shape}")
    if isinstance(used, PageFilter) and used.follows_from:
        own_slopes = own_slopes + _following(used, given_model, slopes)
    wanted = wanted._replace(own=bool(own_slopes.any()))
    repeated = RepeatedRuns(
        *(model, page, wanted, inputs, measurements),
        density=density,
        blocks=blocks,
        starts=starts,
        truth=truth,
    )
    return repeated(model.numbers, moves_of(slopes, own_slopes, model), own_parameters)


class RepeatedRuns:
    """`derivatives` on the same runs for many numbers of one model, without finding its code anew.

    Arguments are those of `derivatives`; the page is that of the filter, and the prior of runs without a start of
    their own is the model's.
    """

    def __init__(
        self,
        model: StateSpaceModel,
        page: Page,
        wanted: Wanted,
        inputs: np.ndarray,
        measurements: np.ndarray,
        *,
        density: Density | None = None,
        blocks: int = 1,
        starts: Starts | None = None,
        truth: Truth | None = None,
    ):
        """Find the compiled recursion; see the class for the arguments."""
        m, density = model.m, density or Density(np.inf, np.ones(model.m))
        if model.measured_turns and not (density.seen > 0).all():
            raise ValueError("predicted must be false for measurements with rotations, but some channels are true")
        begun = as_the_prior_says(model, len(measurements)) if starts is None else starts
        states, weights = truth or Truth(np.zeros((len(measurements), 0, 0)), np.zeros(0))
        self._recursion = recursion_of(model.functions, model.any_shape, wanted, page, is_interpreting())
        self._blocks, self._informative = blocks, wanted.information
        turns = 1 if (density.seen > 0).all() else 2  # channels that are predicted only come after the others
        tails = [tail_of(np.inf, m), tail_of(density.degrees, m)]
        self._tails, self._weights = tails if turns == 2 else tails[::-1], np.diag(weights).ravel()
        arrays = inputs, measurements, states, _begins(model, begun)
        self._data = tuple(np.ascontiguousarray(array) for array in arrays)
        fed = np.array(of_channels(density.seen.tolist(), model.measured_turns), dtype=np.float64)
        moves_prior = 1.0 - (begun.free & begun.held).astype(np.float64)  # of runs whose priors parameters move
        self._settings = moves_prior, begun.counted_from.astype(np.float64), fed, turns

    def __call__(
        self, numbers: np.ndarray, moves: np.ndarray, own_parameters: Sequence[float] | np.ndarray = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """The results of `derivatives` for a model's numbers and rows of `moves_of`."""
        count, parameters = len(self._data[1]), len(moves)
        numbers = np.concatenate([numbers, *self._tails, own_parameters, self._weights])
        out = np.zeros((count, self._blocks, 1 + parameters))
        information = np.zeros((count, parameters, parameters) if self._informative else (count, 0, 0))
        moves = moves if parameters else np.zeros((1, moves.shape[1]))  # compiled code reads a row
        arguments = *self._data, numbers, moves, *self._settings, out, information
        at_once, sizes, run = self._recursion.at_once, self._recursion.sizes(parameters), self._recursion.run

        def run_some(first: int, last: int) -> None:
            memory = (np.zeros(size) for size in sizes)
            run(*arguments, *memory, first * at_once, min(last * at_once, count))

        spread(run_some, -(-count // at_once))
        return out, information


def _following(used: PageFilter, model: StateSpaceModel, slopes: ModelSlopes) -> np.ndarray:
    """Slopes (p, count) of own parameters that follow from numbers of the model, by central differences."""
    changes = np.zeros((len(slopes.constants), len(used.own_parameters)))
    for name in {name for names in used.follows_from.values() for name in names}:
        for row, slope in zip(changes, getattr(slopes, name), strict=True):
            if slope.any():
                ends = (getattr(model, name) + side * STEP * slope for side in (1.0, -1.0))
                ahead, behind = (replace(used, model=model.replace(**{name: end})).own_parameters for end in ends)
                row += np.subtract(ahead, behind) / (2.0 * STEP)
    return changes


def _begins(model: StateSpaceModel, starts: Starts) -> np.ndarray:
    """Mean and covariance of each run at its beginning, (B, n + t^2)."""
    free, count = starts.free[:, None], len(starts.free)
    means = wrapped_where(np.where(free, starts.means, model.prior_mean), model.any_shape.state_angles)
    covs = np.where(free[..., None], starts.covs, model.prior_cov)
    return np.concatenate([means, covs.reshape(count, model.t**2)], axis=1)


def moves_of(slopes: ModelSlopes, own_slopes: np.ndarray, model: StateSpaceModel) -> np.ndarray:
    """Rows of parameters as in `Memory`."""
    p, tt, mm = len(slopes.constants), model.t**2, model.m**2
    noise = slopes.process_noise_cov.reshape(p, tt), slopes.measurement_noise_cov.reshape(p, mm)
    prior = slopes.prior_mean, slopes.prior_cov.reshape(p, tt)
    of_constants = slopes.constants, _relative(slopes.constants, model)[:, None]
    return np.concatenate([*noise, *of_constants, *prior, own_slopes], axis=1)


def _relative(slopes: np.ndarray, model: StateSpaceModel) -> np.ndarray:
    """The largest of |dc|/(|c| + |dc|) for each parameter, (p,), in which steps along it are measured."""
    base = np.abs(np.array(model.constants, dtype=np.float64)) + np.abs(slopes)
    return (np.abs(slopes) / np.where(base > 0, base, 1.0)).max(axis=1, initial=0.0)


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
        filter: one of `KINDS`, or your own; its model is replaced by `model`.
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
    wanted = (count, steps, model.inputs), (count, steps + 1, model.channels), *of_slopes
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
