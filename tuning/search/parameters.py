"""The parameters of a model that a study may choose: each one's name, range, unit and place in a choice."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from filters.filter import Filter
from filters.particles.kernels import WeightedFilter
from filters.particles.particle import RaoBlackwellisedParticleFilter
from filters.registry import FilterType, filter_type
from filters.tuned_file import NOISE
from filters.tuned_file import PRIOR as PRIOR_FACTOR
from thruster_env.core.checks import covariance, short_repr
from tuning.problems.problem import Argument, Parameter, Place, Problem, squared

# Relations among a model's parameters that a search obeys: equal, in proportion, fixed, bounded.
#
# Setting a free parameter also sets those that depend on it, so other code need not handle relations. Examples:
#
#     Q22 = 4 Q11         four times Q11, whatever Q11 is
#     Q33 = Q11           the same
#     R = 0.01            not tuned
#     Q11 = 1e-6..1e-2    within this range


NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
FORM = re.compile(
    rf"\s*(?P<name>[^\s=]+)\s*=\s*"
    rf"(?:(?P<low>{NUMBER})\s*\.\.\s*(?P<high>{NUMBER})"
    rf"|(?P<factor>{NUMBER})\s*\*?\s*(?P<in_proportion>[^\W\d]\w*)"
    rf"|(?P<value>{NUMBER})"
    rf"|(?P<equal>[^\W\d]\w*))\s*"
)
RULE = "a relation must be NAME = [FACTOR] NAME, NAME = VALUE or NAME = LOW..HIGH"
ROUNDING = 1e-12  # of correlations: what is below is nothing


class Relation(NamedTuple):
    """The relation of one parameter: proportional to another, fixed, or within a range."""

    name: str
    of: str | None = None
    factor: float = 1.0
    value: float | None = None
    ends: tuple[float, float] | None = None


def relation_of(text: str) -> Relation:
    """A relation from its text; ValueError for another form."""
    match = FORM.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f"{RULE}, but got {short_repr(text)}")
    name, of = match["name"], match["in_proportion"] or match["equal"]
    if match["value"]:
        return Relation(name, value=float(match["value"]))
    if match["low"]:
        return Relation(name, ends=(float(match["low"]), float(match["high"])))
    return Relation(name, of, float(match["factor"] or 1.0))


def related(parameters: Sequence[Parameter], relations: Sequence[str]) -> list[Parameter]:
    """The free parameters under some relations; choices that they set obey these.

    Args:
        parameters: all parameters.
        relations: texts, such as "Q22 = 4 Q11".

    Raises:
        ValueError: for another form, an unknown name, a parameter with two relations or in proportion to one that
            is not free, an invalid value, or if no parameter is left to tune.
    """
    parsed = [relation_of(text) for text in relations]
    known = {parameter.name: parameter for parameter in parameters}
    names = [relation.name for relation in parsed]
    for relation, text in zip(parsed, relations, strict=True):
        unknown = next((name for name in (relation.name, relation.of) if name and name not in known), None)
        if unknown is not None:
            raise ValueError(f"relations must be among {', '.join(known)}, but got {short_repr(text)}")
        if names.count(relation.name) > 1:
            raise ValueError(f"each parameter must have at most one relation, but {relation.name} has more")
        _check(known[relation.name], relation, text)
    bound = {relation.name for relation in parsed if relation.ends is None}
    for relation, text in zip(parsed, relations, strict=True):
        if relation.of in bound:
            raise ValueError(f"numbers must be in proportion to one that is free, but got {short_repr(text)}")
    free = {parameter.name: parameter for parameter in parameters if parameter.name not in bound}
    if not free:
        raise ValueError(f"relations must leave a parameter to tune, but got {', '.join(relations)}")
    for relation in parsed:
        if relation.of:
            root = free[relation.of]
            free[relation.of] = replace(root, tied=(*root.tied, (known[relation.name].place, relation.factor)))
        elif relation.ends:
            low, high = relation.ends
            free[relation.name] = replace(free[relation.name], low=low, high=high, first=None, default=None)
    fixed = tuple(
        (known[relation.name].place, relation.value) for relation in parsed if relation.value is not None
    )
    return [replace(parameter, held=fixed) for parameter in free.values()]


def _check(parameter: Parameter, relation: Relation, text: str) -> None:
    """Raise ValueError unless a number can be what its relation says."""
    least = 0.0 if parameter.place.is_variance else -1.0 if "correlation" in parameter.name else None
    most = -least if least is not None and least < 0 else None
    for value in (relation.value, *(relation.ends or ())):
        if value is None or least is None:
            continue
        if value <= least or (most is not None and value >= most):
            rule = "positive" if most is None else "within -1 and 1"
            raise ValueError(f"{parameter.name} must be {rule}, but got {short_repr(text)}")
    if relation.of and parameter.place.is_variance and relation.factor <= 0:
        raise ValueError(f"a variance must be a positive multiple, but got {short_repr(text)}")
    if relation.ends and not relation.ends[0] < relation.ends[1]:
        raise ValueError(f"a range must be LOW..HIGH with LOW below HIGH, but got {short_repr(text)}")


def obeying(choice, parameters: Sequence[Parameter]):
    """The choice with the same free parameters, within their ranges, and the dependent and fixed ones set."""
    for parameter in parameters:
        if (value := parameter.get(choice)) is not None:
            choice = parameter.set(choice, min(max(value, parameter.low), parameter.high))
    return choice


def full_covariance(variances: Sequence[float], correlations: Sequence[float]) -> np.ndarray:
    """A covariance (n, n), positive semidefinite by construction: S L L' S, S the standard deviations.

    L is the Cholesky factor of the correlations, by rows: with r_ij the correlation of states i and j once the
    states before j are known, L_ij = r_ij sqrt(1 - sum_{k<j} L_ik^2) for j < i, and L_ii the root that remains.

    Args:
        variances: n numbers of at least zero.
        correlations: r_21, r_31, r_32, ..., n (n - 1) / 2 numbers from -1 to 1. For two states the one is the
            correlation itself.

    Raises:
        ValueError: if a variance is negative, a correlation is not from -1 to 1, or there are too few.

    Source: Lewandowski, Kurowicka, Joe (2009), "Generating random correlation matrices based on vines and extended
    onion method", J. Multivariate Analysis 100(9).
    """
    diagonal, count = np.asarray(variances, dtype=np.float64), len(variances) * (len(variances) - 1) // 2
    if not (diagonal >= 0).all():
        raise ValueError(f"variances must be at least zero, but got {diagonal.tolist()}")
    if len(correlations) != count or not all(abs(r) <= 1 for r in correlations):
        raise ValueError(f"correlations must be {count} numbers from -1 to 1, but got {list(correlations)}")
    factor = np.sqrt(diagonal)[:, None] * _lower(len(diagonal), correlations)
    return factor @ factor.T


def correlation_slopes(variances: Sequence[float], correlations: Sequence[float]) -> np.ndarray:
    """Derivatives of `full_covariance` by its correlations, (n (n - 1) / 2, n, n).

    Only row i of L depends on r_ij: L_ij grows with sqrt(1 - sum_{k<j} L_ik^2), and later entries shrink
    with r_ij / (1 - r_ij^2).
    """
    n = len(variances)
    lower, deviations = _lower(n, correlations), np.sqrt(np.asarray(variances, dtype=np.float64))
    slopes, values, k = np.zeros((len(correlations), n, n)), list(correlations), 0
    for i in range(n):
        for j in range(i):
            by = np.zeros(n)
            by[j] = np.sqrt(max(1.0 - float(lower[i, :j] @ lower[i, :j]), 0.0))
            by[j + 1 :] = -values[k] / (1.0 - values[k] ** 2) * lower[i, j + 1 :]
            row = deviations[i] * deviations * (lower @ by)
            row[i] = 0.0  # the variance stays
            slopes[k, i], slopes[k, :, i] = row, row
            k += 1
    return slopes


def _lower(n: int, correlations: Sequence[float]) -> np.ndarray:
    lower, remaining = np.zeros((n, n)), iter(correlations)
    for i, row in enumerate(lower):
        for j in range(i):
            row[j] = next(remaining) * np.sqrt(max(1.0 - float(row[:j] @ row[:j]), 0.0))
        row[i] = np.sqrt(max(1.0 - float(row[:i] @ row[:i]), 0.0))
    return lower


def correlations_of(cov: np.ndarray) -> list[float]:
    """The correlations from which `full_covariance` makes a covariance (n, n), which may be singular.

    An undetermined correlation is 0: that of a state with no variance, or with one determined by other states.
    """
    deviations = np.sqrt(np.diag(cov))
    scale = np.where(deviations > 0, deviations, 1.0)
    wanted = np.asarray(cov) / np.outer(scale, scale)
    lower, correlations = np.zeros(wanted.shape), []
    for i, row in enumerate(lower):
        for j in range(i):
            rest, pivot = np.sqrt(max(1.0 - row[:j] @ row[:j], 0.0)), lower[j, j]
            partial = wanted[i, j] - row[:j] @ lower[j, :j]
            row[j] = np.clip(partial / pivot, -rest, rest) if pivot > 0 and rest > ROUNDING else 0.0
            correlations.append(float(row[j] / rest) if rest > ROUNDING else 0.0)
        left = wanted[i, i] - row[:i] @ row[:i]
        row[i] = np.sqrt(left) if left > ROUNDING else 0.0
    return correlations


Q, R = NOISE  # arguments of the model
FACTORS = (1e-10, 1e4)  # range of each variance of Q and R, as factors on that of the rule of thumb
Q_FIRST, R_FIRST = (1e-5, 1e2), (1e-2, 1e3)  # the part of it in which a search begins
CORRELATIONS = (-0.99, 0.99)  # range of each correlation in a full Q or R
PRIOR_FACTORS = (1e-4, 1e2)  # range of P_0, as a factor on the covariance of the plant's initial state
PRIOR = Argument(PRIOR_FACTOR, is_variance=True)
SIZE_LADDER = (5, 7, 10, 14, 20, 30, 50, 70, 100, 140, 200, 300, 500, 700, 1000, 1400, 2000, 3000, 5000)


@dataclass(frozen=True)
class ProcessVariance:
    """Variance of one state in Q; the correlations stay."""

    index: int
    is_variance: ClassVar[bool] = True

    def get(self, choice) -> float | None:
        """The variance in a choice."""
        q = choice.model.get(Q)
        return None if q is None else float(_diagonal(q)[self.index])

    def set(self, choice, value):
        """The choice with another variance."""
        return _with_variance(choice, Q, self.index, value)


@dataclass(frozen=True)
class Correlation:
    """One of the correlations from which `relations.full_covariance` makes a full Q or R."""

    covariance: str  # argument of the model
    index: int
    is_variance: ClassVar[bool] = False

    def get(self, choice) -> float:
        """The correlation in a choice; zero if the covariance is diagonal."""
        cov = choice.model.get(self.covariance)
        return 0.0 if cov is None or np.ndim(cov) < 2 else correlations_of(np.asarray(cov))[self.index]

    def set(self, choice, value):
        """The choice with another correlation, and so with a full covariance."""
        before = choice.model[self.covariance]
        if np.ndim(before) == 2 and value == self.get(choice):
            return choice  # to the last digit
        variances = _diagonal(before)
        count = len(variances) * (len(variances) - 1) // 2
        correlations = correlations_of(np.asarray(before)) if np.ndim(before) == 2 else [0.0] * count
        clipped = np.clip(correlations, *CORRELATIONS).tolist()  # those of a singular Q may be 1
        cov = full_covariance(variances, _replaced(clipped, self.index, value))
        return choice._replace(model={**choice.model, self.covariance: tuple(map(tuple, cov.tolist()))})


@dataclass(frozen=True)
class MeasurementVariance:
    """Variance of one channel in R."""

    index: int
    is_variance: ClassVar[bool] = True

    def get(self, choice) -> float | None:
        """The variance in a choice."""
        r = choice.model.get(R)
        return r if r is None or np.ndim(r) == 0 else float(_diagonal(r)[self.index])

    def set(self, choice, value):
        """The choice with another variance."""
        return _with_variance(choice, R, self.index, value)


def has_process_noise(problem: Problem) -> bool:
    """Whether a problem has process noise in the untuned filter, or parameters from which it follows."""
    return problem.parameters is not None or bool(np.any(problem.untuned.get(Q, True)))


def model_parameters(
    problem: Problem,
    *,
    hold_r: bool = False,
    full_q: bool = False,
    full_r: bool = False,
    prior: bool = False,
    where: Sequence[str] = (),
) -> list[Parameter]:
    """Parameters of a problem's model that a study may choose: its `parameters`, or the variances of Q and R.

    Args:
        problem: the ranges follow from its untuned values.
        hold_r: keep R from the sensor's data sheet.
        full_q: choose the correlations of Q, too (`relations.full_covariance`).
        full_r: choose those of R, too.
        prior: choose the scale of P_0, too.
        where: relations among them (`tuning.search.parameters`), which reduce the free ones.
    """
    parameters = _all_parameters(problem, hold_r=hold_r, full_q=full_q, full_r=full_r, prior=prior)
    return related(parameters, where) if where else parameters


def index_pairs(text: str) -> str:
    """A text with the indices of its variances apart where they have two digits: Q1010 is Q10,10."""
    return re.sub(r"\b([QR])(\d{2,})\2\b", r"\1\2,\2", text)


def _all_parameters(problem: Problem, *, hold_r: bool, full_q: bool, full_r: bool, prior: bool) -> list[Parameter]:
    if problem.parameters is not None:
        return list(problem.parameters)
    untuned, parameters = problem.untuned, []
    variances, errors = _diagonal(untuned[Q]), problem.errors
    user_values = untuned if problem.given is None else problem.given
    given_q, given_r = _diagonal(user_values[Q]), _diagonal(user_values[R])
    scales = [*(() if problem.scale is None else problem.scale), *[0.0] * len(errors)]
    for i, (variance, state) in enumerate(zip(variances, errors, strict=True)):
        if variance > 0:  # otherwise the state has no noise, and no range
            # Where the input hardly moves a state, noise may move it more.
            scale = scales[i] if np.isfinite(scales[i]) else 0.0
            ends = _range(variance, given_q[i], max(variance, scale**2))
            parameters.append(_variance(f"Q{i + 1}{i + 1}", ends, Q_FIRST, state.unit, ProcessVariance(i)))
    if full_q:
        parameters += _correlations(Q, len(errors))
    if not hold_r:
        channels = problem.innovations
        for i, (variance, channel) in enumerate(zip(_diagonal(untuned[R]), channels, strict=True)):
            ends = _range(variance, given_r[i], variance)
            name, location = r_name(i, len(channels)), MeasurementVariance(i)
            parameters.append(_variance(name, ends, R_FIRST, channel.unit, location))
        parameters += _correlations(R, len(channels)) if full_r else []
    if prior:
        parameters.append(Parameter("P0", *PRIOR_FACTORS, place=PRIOR))
    return parameters


def _variance(
    name: str, ends: tuple[float, float], factors: tuple[float, float], unit: str, location: Place
) -> Parameter:
    """A variance of Q or R, with the part of its range in which a search begins."""
    first = ends[0] * factors[0] / FACTORS[0], ends[1] * factors[1] / FACTORS[1]
    return Parameter(name, *ends, unit=squared(unit), first=first, place=location)


def _correlations(covariance: str, size: int) -> list[Parameter]:
    names = correlation_names(size, covariance)
    locations = [Correlation(covariance, k) for k in range(len(names))]
    return [
        Parameter(name, *CORRELATIONS, log=False, place=location)
        for name, location in zip(names, locations, strict=True)
    ]


def _range(variance: float, user_value: float, largest: float) -> tuple[float, float]:
    """The range of a variance, by the rule of thumb; what was given lies inside."""
    low, high = FACTORS[0] * variance, FACTORS[1] * largest
    return (min(low, user_value) if user_value > 0 else low), max(high, user_value)


def places_in(choice) -> dict[str, Place]:
    """Places of the parameters of a choice's model, by name.

    Correlations and P0 are among them where the choice has a full Q and a factor on P_0.
    """
    locations: dict[str, Place] = {}
    if not filter_type(choice.name).has_covariance:
        return locations
    q, r = choice.model.get(Q), choice.model.get(R)
    locations |= {name: Argument(name) for name in choice.model if name not in (Q, R, PRIOR.name)}
    if q is not None:
        locations |= {f"Q{i + 1}{i + 1}": ProcessVariance(i) for i in range(len(q))}
        if np.ndim(q) == 2:
            locations |= {name: Correlation(Q, k) for k, name in enumerate(correlation_names(len(q)))}
    if r is not None:
        count = np.size(_diagonal(r))
        locations |= {r_name(i, count): MeasurementVariance(i) for i in range(count)}
        if np.ndim(r) == 2:
            locations |= {name: Correlation(R, k) for k, name in enumerate(correlation_names(count, R))}
    if PRIOR.name in choice.model:
        locations["P0"] = PRIOR
    return locations


def correlation_names(size: int, covariance: str = Q) -> list[str]:
    """Names of the correlations of Q or R as trial parameters, in the order of `relations.full_covariance`."""
    stem, between = "correlation" if covariance == Q else "R_correlation", "" if size < 10 else "_"
    return [f"{stem}_{j}{between}{i}" for i in range(2, size + 1) for j in range(1, i)]


def r_name(index: int, channels: int) -> str:
    """Name of a channel's variance in R as a trial parameter: "R" of a single channel, else "R11", "R22", ..."""
    return "R" if channels == 1 else f"R{index + 1}{index + 1}"


def _diagonal(cov) -> tuple[float, ...]:
    """Variances of a covariance as a choice stores it: one variance, several, or the rows of a matrix."""
    if np.ndim(cov) == 1:
        return tuple(cov)
    return (cov,) if np.ndim(cov) == 0 else tuple(np.diag(covariance("a covariance", cov, len(cov))).tolist())


def _with_variance(choice, argument: str, index: int, value: float):
    """A choice with another variance in Q or R, whose correlations stay."""
    before = choice.model[argument]
    after: float | tuple
    if np.ndim(before) == 0:
        after = value
    elif np.ndim(before) == 1:
        after = _replaced(tuple(before), index, value)
    else:
        cov = np.array(before)
        factor = np.sqrt(value / cov[index, index])
        cov[index] *= factor
        cov[:, index] *= factor
        cov[index, index] = value
        after = tuple(map(tuple, cov.tolist()))
    return choice._replace(model={**choice.model, argument: after})


def _replaced(values: Sequence[float], index: int, value: float) -> tuple[float, ...]:
    return (*values[:index], value, *values[index + 1 :])


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
    parameter.name: parameter
    for parameter in (
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
WITHOUT_NOISE = {
    parameter.name: parameter
    for parameter in (_own("regularisation", 0.0, 3.0), _own("window", 0, 3, integer=True))
}


def filter_parameters(kind: FilterType, process_noise: bool) -> list[Parameter]:
    """Parameters of a filter that a study may choose: N, if it has an ensemble, and the others.

    An estimator declares its own parameters. Some parameters are chosen only without process noise.
    """
    if kind.is_estimator:
        return [replace(parameter, place=FilterParameter(parameter.name)) for parameter in kind.declared]
    if kind.is_foreign:
        filter_class = kind.filter_class
        return [
            _own_of_user(filter_class, number, *ends)
            for number, ends in getattr(filter_class, "ranges", {}).items()
        ]
    known, parameters = kind.numbers, []
    if kind.has_ensemble:
        _, low, high = ensemble_sizes_of(kind)
        parameters = [Parameter("N", low, high, integer=True, place=FilterParameter("ensemble_size"))]
    numbers = FILTER_PARAMETERS if process_noise else FILTER_PARAMETERS | WITHOUT_NOISE
    return parameters + [parameter for number, parameter in numbers.items() if number in known]


def _own_of_user(kind: type[Filter], number: str, low: float, high: float) -> Parameter:
    """A field of a user's filter: a whole number where its default is one, logarithmic over a factor of ten."""
    default = getattr(kind, number)
    options = {"integer": True} if isinstance(default, int) else {"log": 0 < 10 * low <= high}
    return _own(number, low, high, default=default, **options)
