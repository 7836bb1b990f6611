"""Identifiability of a filter's noise covariances from the innovations of the runs that it was tuned on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from optuna.distributions import BaseDistribution

from filters.registry import filter_type
from filters.tuned_file import NOISE
from thruster_env.core.checks import in_words
from tuning.evaluation.residuals import heavy_innovations, tails_in_words
from tuning.likelihood.objective import Objective
from tuning.likelihood.parametric import Family, has_gradient
from tuning.problems.data import Data, estimates_in_parts, where_true
from tuning.problems.problem import Problem
from tuning.search.parameters import index_pairs, model_parameters, places_in
from tuning.search.space import Choice, choice_of, ends_of, parameters_of, untuned_choice

KNOWN_WITHIN = np.log(10.0)  # a parameter with a wider 95 % interval than a factor of ten is not determined
TWO_SIDED = 1.96  # standard errors of a 95 % interval
SIGNIFICANT = 1.92  # fall in log-likelihood: half of the 95 % point of chi-squared with one degree of freedom
STEP = np.log(2.0)  # of differences, in logarithms: ensembles need large ones
CLOSE = 0.02  # tolerance of the maximum, in logarithms
EVALUATIONS = 100  # at most, in the search of the maximum
LEAST = -1e6  # in place of a log-likelihood that is not finite
LEAST_NUMBERS = 8  # number of parameters from which the information is faster than differences
MOST_NUMBERS = 24  # a curvature takes a run of all data for each pair of parameters
COMPANION = 0.2  # component of a direction, relative to the largest one, from which a parameter is named


class Identifiability(NamedTuple):
    """What the innovations of B runs determine of p positive parameters; covariances are of their logarithms."""

    names: tuple[str, ...]
    tuned: np.ndarray  # (p,), the choice of the study
    most_likely: np.ndarray  # (p,), under which the innovations are most likely
    cov: np.ndarray  # (p, p)
    identified: np.ndarray  # (p,) bool, as `is_identified` says
    tails: Mapping[str, float] = {}  # of innovations at the most likely values, if heavy: then all above is wrong

    @property
    def factors(self) -> np.ndarray:
        """The 95 % interval of each parameter is the most likely value, divided and multiplied by this, (p,)."""
        return np.exp(TWO_SIDED * np.sqrt(np.diag(self.cov)))

    @property
    def least_determined(self) -> dict[str, float]:
        """The least determined direction: factors on the parameters when the first of them grows by ten.

        Only parameters with a component in it are listed.
        """
        axis = np.linalg.eigh(self.cov)[1][:, -1]
        order = np.argsort(-abs(axis))
        parts = axis[order] / axis[order[0]]
        return {
            self.names[i]: float(10.0**part)
            for i, part in zip(order, parts, strict=True)
            if abs(part) >= COMPANION
        }


def identify(
    choice: Choice,
    scenarios: Sequence[Problem],
    data: Sequence[Data],
    space: Mapping[str, BaseDistribution],
    where: Sequence[str] = (),
) -> Identifiability | None:
    """How well the innovations determine the parameters of a choice's model; None without a covariance.

    By default these are Q's variances, R and the scale of P_0. For more than 24 parameters it is None, too.

    It works for every filter with a covariance: only the log-likelihood of its innovations is needed.

    Args:
        choice: choice of one filter type; the filter's own parameters are held.
        scenarios: the problems.
        data: for each scenario, the training data.
        space: distributions of the tuned parameters, `Plan.space`.
        where: relations among the model's numbers.
    """
    parameters = parameters_of(choice)
    names = _names(choice, space)
    if not 0 < len(names) <= MOST_NUMBERS:
        return None

    def log_likelihoods(logarithms: np.ndarray) -> np.ndarray:
        values = {
            **parameters,
            **{name: float(value) for name, value in zip(names, np.exp(logarithms), strict=True)},
        }
        parts = []
        for scenario, runs in zip(scenarios, data, strict=True):
            filter_ = choice_of(choice.name, values, scenario, where).filter(scenario)
            parts_of_runs = estimates_in_parts(filter_, runs)
            first = runs.first_scored if scenario.leads_in else 0
            parts += [
                _in_run(part, estimates.log_likelihoods)[:, first:].sum(axis=1)
                for part, estimates in parts_of_runs
            ]
        totals = np.concatenate(parts)
        return np.where(np.isfinite(totals), totals, LEAST)

    tuned = np.array([parameters[name] for name in names])
    bounds = np.log([ends_of(space[name]) for name in names])
    untuned = parameters_of(untuned_choice(choice.name, scenarios[0]))
    starts = np.log(tuned), np.log([untuned.get(name, parameters[name]) for name in names])
    best = maximum(log_likelihoods, starts, bounds)
    known = known_information(choice, scenarios, data, names, np.exp(best), where)
    cov = covariance(curvatures(log_likelihoods, best) if known is None else known)
    identified = is_identified(log_likelihoods, best, cov, bounds)
    tails: dict[str, float] = {}
    for scenario, runs in zip(scenarios, data, strict=True):
        most_likely = {**parameters, **dict(zip(names, np.exp(best).tolist(), strict=True))}
        tails |= heavy_innovations(choice_of(choice.name, most_likely, scenario, where).filter(scenario), [runs])
    return Identifiability(names, tuned, np.exp(best), cov, identified, tails)


def known_information(
    choice: Choice,
    scenarios: Sequence[Problem],
    data: Sequence[Data],
    names: Sequence[str],
    values: np.ndarray,
    where: Sequence[str] = (),
) -> np.ndarray | None:
    """Fisher information on the logarithms of a Kalman filter's parameters in each of B runs, (B, p, p).

    None for other filters, and where a parameter changes the model's functions or is on another scale. It takes
    the time of about fifteen runs of the filter; differences take two runs for each pair of parameters.

    Args:
        choice: choice of one filter type; its other parameters are held.
        scenarios: the problems.
        data: for each scenario, its runs.
        names: names of the p parameters.
        values: at which the information is taken, (p,).
        where: relations among the model's numbers.
    """
    if not has_gradient(choice.name) or len(names) < LEAST_NUMBERS:
        return None
    parts = []
    for scenario, runs in zip(scenarios, data, strict=True):
        free = model_parameters(scenario, where=where)
        known = {parameter.name: parameter for parameter in free if parameter.log}
        if not set(names) <= set(known):
            return None
        try:
            parts.append(Family(choice, scenario, [known[name] for name in names], runs))
        except ValueError:  # more than numbers changes
            return None
    return Objective(parts, information=True).information_of_runs(np.log(values))


def _in_run(data: Data, log_likelihoods: np.ndarray) -> np.ndarray:
    """Log-likelihoods of steps, (B, K + 1), with zeros in the padding of runs."""
    if data.counted is None:
        return log_likelihoods
    return where_true(np.arange(data.steps + 1) < data.rows[:, None], log_likelihoods, 0.0)


def too_many(choice: Choice, space: Mapping[str, BaseDistribution]) -> list[str]:
    """A sentence if identifiability is not computed because of too many parameters; else nothing."""
    count = len(_names(choice, space))
    if count <= MOST_NUMBERS:
        return []
    rule = f"Identifiability is computed for at most {MOST_NUMBERS} parameters"
    return [f"{rule}; here are {count}. A problem may define its own, fewer parameters."]


def _names(choice: Choice, space: Mapping[str, BaseDistribution]) -> tuple[str, ...]:
    """The tuned parameters of the model; none without a covariance. Correlations and zeros have no logarithm.

    Parameters of a problem's own are none where the choice has a Q and R that they do not give.
    """
    if not filter_type(choice.name).has_covariance:
        return ()
    positions, parameters = places_in(choice), parameters_of(choice)
    without = [name for name in choice.model if set(NOISE) & set(choice.model)]
    logarithmic = [name for name, range_ in space.items() if name in positions and getattr(range_, "log", False)]
    return tuple(name for name in logarithmic if name not in without and parameters[name] > 0)


def maximum(
    log_likelihoods: Callable[[np.ndarray], np.ndarray], starts: Sequence[np.ndarray], bounds: np.ndarray
) -> np.ndarray:
    """The maximum of the log-likelihood of all runs, (p,), by quadratic models without derivatives.

    Args:
        log_likelihoods: the function that returns those of all runs, (B,), at logarithms (p,).
        starts: points (p,); the search begins at the most likely of them.
        bounds: low and high, (p, 2).

    Source: Ragonneau, Zhang (2023), "COBYQA: a derivative-free trust-region SQP method".
    """
    from scipy.optimize import minimize

    def negative(logarithms: np.ndarray) -> float:
        return -log_likelihoods(logarithms).sum()

    minimum = minimize(
        negative,
        min((np.clip(start, *bounds.T) for start in starts), key=negative),
        method="COBYQA",
        bounds=bounds,
        options={"initial_tr_radius": STEP, "final_tr_radius": CLOSE, "maxfev": EVALUATIONS},
    )
    return minimum.x


def curvatures(log_likelihoods: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """Minus the second derivatives of B log-likelihoods, (B, p, p), by central differences of a factor of two.

    Args:
        log_likelihoods: the function that returns those of all runs, (B,), at logarithms (p,).
        at: the logarithms, (p,).
    """
    count, steps = len(at), STEP * np.eye(len(at))
    here = log_likelihoods(at)
    above, below = (np.array([log_likelihoods(at + sign * step) - here for step in steps]) for sign in (1, -1))
    matrices = np.empty((len(here), count, count))
    for i in range(count):
        matrices[:, i, i] = -(above[i] + below[i]) / STEP**2
        for j in range(i):
            both = sum(log_likelihoods(at + sign * (steps[i] + steps[j])) - here for sign in (1, -1))
            mixed = both - above[i] - below[i] - above[j] - below[j]
            matrices[:, i, j] = matrices[:, j, i] = -mixed / (2.0 * STEP**2)
    return matrices


def covariance(curvatures: np.ndarray) -> np.ndarray:
    """Covariance (p, p) of the logarithms of p parameters, from the curvature of a log-likelihood at its maximum.

        H = - sum over runs of d2 log L / d theta2,   C = (H_sure + I / (ln 10)^2)^-1

    H_sure has H's directions. The curvature in each direction is that of H minus 1.96 of its standard errors over
    runs, and at least zero, because noise is not information. The last term is the prior: the order of magnitude
    is known. So a parameter on which the data have no information has a standard error of a factor of ten.

    Args:
        curvatures: of each of B independent runs, (B, p, p), or their expectations, Fisher's information.

    Source: Kay (1993), "Fundamentals of statistical signal processing: estimation theory", chapter 7 (observed
    information).
    """
    total, axes = np.linalg.eigh(curvatures.sum(axis=0))
    along = np.einsum("id,bij,jd->bd", axes, curvatures, axes)
    errors = np.sqrt(len(along)) * along.std(axis=0, ddof=1)
    sure = np.maximum(total - TWO_SIDED * errors, 0.0)
    return np.linalg.inv(axes * sure @ axes.T + np.eye(len(total)) / KNOWN_WITHIN**2)


def is_identified(
    log_likelihoods: Callable[[np.ndarray], np.ndarray], at: np.ndarray, cov: np.ndarray, bounds: np.ndarray
) -> np.ndarray:
    """Whether the data determine each of p parameters within a factor of ten, (p,) bool.

    They do if its 95 % interval is within that, if ten times more and ten times less are significantly less likely
    (log L falls by 1.92) when the other parameters move with it as in `cov`, and if the maximum is not at an end
    of the range. The second rule detects a missing limit on one side, which a curvature does not show.

    Args:
        log_likelihoods: the function that returns those of all runs, (B,), at logarithms (p,).
        at: the logarithms under which the runs are most likely, (p,).
        cov: from `covariance`.
        bounds: low and high, (p, 2).

    Source: Raue et al. (2009), "Structural and practical identifiability analysis of partially observed
    dynamical models by exploiting the profile likelihood", Bioinformatics 25(15), where a number is practically
    not identifiable if its likelihood-based interval has no end.
    """
    variances, highest = np.diag(cov), log_likelihoods(at).sum()
    narrow = TWO_SIDED * np.sqrt(variances) < KNOWN_WITHIN
    inside = (at > bounds[:, 0] + CLOSE) & (at < bounds[:, 1] - CLOSE)
    moves = KNOWN_WITHIN * cov / variances[:, None]
    # Where one parameter is known far better than another, the other would move by a hundred orders of magnitude.
    low, high = bounds[:, 0] - KNOWN_WITHIN, bounds[:, 1] + KNOWN_WITHIN
    falls = [
        [highest - log_likelihoods(np.clip(at + sign * move, low, high)).sum() for sign in (1, -1)]
        for move in moves
    ]
    return narrow & inside & (np.array(falls) > SIGNIFICANT).all(axis=1)


def sentences(result: Identifiability) -> list[str]:
    """Sentences on which parameters the innovations determine."""
    rows = list(zip(result.names, result.identified, result.factors, strict=True))
    known = [f"{name} within a factor of {factor:.3g}" for name, known, factor in rows if known]
    loose = [name for name, known, _ in rows if not known]
    if result.tails:
        return [
            "How well the innovations of the training runs determine Q and R is not stated: that is known for "
            f"normal innovations, and these have heavy tails, {tails_in_words(result.tails)}. A few outliers may "
            "raise Q or R for all samples; --filter ekf-robust gives them less weight."
        ]
    lines = [f"The innovations of the training runs determine {in_words(known or ['nothing'])} (95 %)."]
    if loose:
        parts = [f"{name} x {factor:.2g}" for name, factor in result.least_determined.items()]
        trade = f" Least determined is a change of several together: {in_words(parts)}." if len(parts) > 1 else ""
        lines.append(
            f"They do not determine {in_words(loose)}: a factor of ten makes no significant difference, or "
            f"the maximum of the likelihood lies at the end of the range.{trade}"
        )
    return list(map(index_pairs, lines))


def as_data(result: Identifiability) -> dict:
    """The result as plain data, by parameter; factors are None for innovations with heavy tails."""
    columns = result.names, result.most_likely.tolist(), result.factors.tolist(), result.identified.tolist()
    return {
        name: {
            "most_likely": best,
            "known_within_a_factor_of": None if result.tails else factor,
            "determined": known and not result.tails,
        }
        for name, best, factor, known in zip(*columns, strict=True)
    }
