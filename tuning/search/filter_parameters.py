"""The parameters of filters besides their model that a study may choose, with ranges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from filters.estimators.find import is_foreign, own_filter, parameters_of
from filters.filter import Filter
from filters.registry import tunable_numbers
from tuning.problems.parameter import Parameter


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


def filter_parameters(name: str, sizes: tuple[int, int] | None, process_noise: bool) -> list[Parameter]:
    """Parameters of a filter that a study may choose: N from `sizes`, if it has an ensemble, and the others.

    An estimator declares its own parameters. Some parameters are chosen only without process noise.
    """
    own = own_filter(name) if is_foreign(name) else None
    if own is not None:
        return [_own_of_user(own, number, *ends) for number, ends in getattr(own, "ranges", {}).items()]
    if is_foreign(name):
        return [replace(one, place=FilterParameter(one.name)) for one in parameters_of(name)]
    size = [] if sizes is None else [Parameter("N", *sizes, integer=True, place=FilterParameter("ensemble_size"))]
    known = tunable_numbers(name)
    numbers = FILTER_PARAMETERS if process_noise else FILTER_PARAMETERS | WITHOUT_NOISE
    return size + [one for number, one in numbers.items() if number in known]


def _own_of_user(kind: type[Filter], number: str, low: float, high: float) -> Parameter:
    """A field of a user's filter: a whole number where its default is one, logarithmic over a factor of ten."""
    default = getattr(kind, number)
    options = {"integer": True} if isinstance(default, int) else {"log": 0 < 10 * low <= high}
    return _own(number, low, high, default=default, **options)
