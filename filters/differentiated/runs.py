"""The log-likelihood of runs and its derivatives along parameters that move all numbers of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from filters.adaptive import RobustExtendedKalmanFilter, SageHusaFilter, VariationalBayesFilter
from filters.algebra.points import tail_of
from filters.differentiated.recursion import Wanted, recursion_of
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
from thruster_env.core.parallel import spread
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import refuse_rotations

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
        begun = as_the_prior_says(model, len(measurements)) if starts is None else starts
        states, weights = truth or Truth(np.zeros((len(measurements), 0, 0)), np.zeros(0))
        self._recursion = recursion_of(model.functions, model.any_shape, wanted, page)
        self._blocks, self._informative = blocks, wanted.information
        turns = 1 if (density.seen > 0).all() else 2  # channels that are predicted only come after the others
        tails = [tail_of(np.inf, m), tail_of(density.degrees, m)]
        self._tails, self._weights = tails if turns == 2 else tails[::-1], np.diag(weights).ravel()
        arrays = inputs, measurements, states, _begins(model, begun)
        self._data = tuple(np.ascontiguousarray(array) for array in arrays)
        moves_prior = 1.0 - (begun.free & begun.held).astype(np.float64)  # of runs whose priors parameters move
        self._settings = moves_prior, begun.counted_from.astype(np.float64), density.seen, turns

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
