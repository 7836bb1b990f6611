"""The parameters of filters besides their model that a study may choose: ranges and untuned values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

from filters.filter import Filter
from filters.particles.particle import RaoBlackwellisedParticleFilter
from filters.particles.weighted import WeightedFilter
from filters.registry import FilterType, filter_type
from tuning.problems.parameter import Parameter

SIZE_LADDER = (5, 7, 10, 14, 20, 30, 50, 70, 100, 140, 200, 300, 500, 700, 1000, 1400, 2000, 3000, 5000)


class Sizes(NamedTuple):
    """Ensemble sizes of a filter type."""

    untuned: int
    low: int  # of the search
    high: int


# The members of a Kalman ensemble represent a mean and a covariance, those of a particle filter a distribution.
KALMAN_SIZES, PARTICLE_SIZES, GAUSSIANS = Sizes(30, 5, 200), Sizes(1000, 200, 5000), Sizes(100, 20, 1000)


def ensemble_sizes_of(kind: FilterType) -> Sizes:
    """Ensemble sizes of a filter that has an ensemble."""
    if issubclass(kind.filter_class, RaoBlackwellisedParticleFilter):
        return GAUSSIANS
    return PARTICLE_SIZES if issubclass(kind.filter_class, WeightedFilter) else KALMAN_SIZES


def size_ladder(name: str) -> tuple[int, ...]:
    """Ensemble sizes of a filter at which a report shows its error, smallest first."""
    _, low, high = ensemble_sizes_of(filter_type(name))
    return tuple(size for size in SIZE_LADDER if low <= size <= high)


@dataclass(frozen=True)
class FilterParameter:
    """One of the filter's parameters."""

    name: str
    is_variance: ClassVar[bool] = False

    def get(self, choice) -> float | int | None:
        """The parameter in a choice."""
        return choice.numbers.get(self.name)

    def set(self, choice, value):
        """The choice with another value of the parameter."""
        return choice._replace(numbers={**choice.numbers, self.name: value})


def _own(name: str, low: float, high: float, **options) -> Parameter:
    return Parameter(name, low, high, **{"log": False, **options}, place=FilterParameter(name))


# Ranges of the parameters that filters have beside Q, R and N; the defaults of all filters lie within them.
# `rotations` is not tuned: a smoother refuses a filter that has some, and a tuned filter can be smoothed.
FILTER_PARAMETERS = {
    one.name: one
    for one in (
        _own("inflation", 1.0, 1.3),
        _own("relaxation", 0.0, 0.9),
        _own("iterations", 1, 8, integer=True),
        _own("alpha", 0.05, 2.0, log=True),
        _own("resampling_threshold", 0.1, 1.0),
        _own("forgetting_factor", 0.9, 0.9999),
        _own("prior_weight", 1.0, 100.0, log=True),
        _own("degrees_of_freedom", 2.5, 50.0, log=True),
        _own("time_constant", 0.2, 50.0, log=True, unit="steps"),
        _own("certainty", 0.3, 5.0, log=True),
        _own("fading", 1.0, 1.3),
        _own("theta", 1e-3, 0.9, log=True),
        _own("stay", 0.0, 0.999),
        _own("outlier_scale", 3.0, 1e4, log=True),
        _own("outlier_rate", 0.001, 0.5, log=True),
        _own("horizon", 5, 50, log=True, integer=True),
        _own("threshold", 1.0, 10.0, log=True),
    )
}


# Without process noise only `regularisation` separates the copies of a particle; with process noise Q does.
# A `window` gains most there; elsewhere a tuned filter shall have none, for neither a smoother nor C takes one.
WITHOUT_NOISE = {one.name: one for one in (_own("regularisation", 0.0, 3.0), _own("window", 0, 3, integer=True))}


def filter_parameters(kind: FilterType, process_noise: bool) -> list[Parameter]:
    """Parameters of a filter that a study may choose: N, if it has an ensemble, and the others.

    An estimator declares its own parameters. Some parameters are chosen only without process noise.
    """
    if kind.is_estimator:
        return [replace(one, place=FilterParameter(one.name)) for one in kind.declared]
    if kind.is_foreign:
        own = kind.filter_class
        return [_own_of_user(own, number, *ends) for number, ends in getattr(own, "ranges", {}).items()]
    known, found = kind.numbers, []
    if kind.has_ensemble:
        _, low, high = ensemble_sizes_of(kind)
        found = [Parameter("N", low, high, integer=True, place=FilterParameter("ensemble_size"))]
    numbers = FILTER_PARAMETERS if process_noise else FILTER_PARAMETERS | WITHOUT_NOISE
    return found + [one for number, one in numbers.items() if number in known]


def default_numbers(kind: FilterType, process_noise: bool) -> dict[str, Any]:
    """The values of these parameters in the untuned filter."""
    own = filter_parameters(kind, process_noise)
    if kind.is_foreign:
        return {one.name: one.start for one in own}
    size = {"ensemble_size": ensemble_sizes_of(kind).untuned} if kind.has_ensemble else {}
    return size | {one.name: getattr(kind.filter_class, one.name) for one in own if one.name != "N"}


def _own_of_user(kind: type[Filter], number: str, low: float, high: float) -> Parameter:
    """A field of a user's filter: a whole number where its default is one, logarithmic over a factor of ten."""
    default = getattr(kind, number)
    options = {"integer": True} if isinstance(default, int) else {"log": 0 < 10 * low <= high}
    return _own(number, low, high, default=default, **options)
