"""Relations among a model's parameters that a search obeys: equal, in proportion, fixed, bounded.

Setting a free parameter also sets those that depend on it, so other code need not handle relations. Examples:

    Q22 = 4 Q11         four times Q11, whatever Q11 is
    Q33 = Q11           the same
    R = 0.01            not tuned
    Q11 = 1e-6..1e-2    within this range
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import short_repr
from tuning.problems.problem import Parameter

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


# A full covariance matrix from variances and correlations, which may be chosen independently of one another.


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
    """The Cholesky factor L of the correlations."""
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
