"""Whether one filter is significantly worse than another one, and whether any is, of many pairs.

A score is the mean over states of RMSE over scale, s = mean_i sqrt(m_i)/c_i, of mean squares m_i pooled over runs.
The influence of one run on it is linear in that run's squares, so the standard error of log(s_a/s_b) is that of a
mean of paired differences (the delta method), and Student's t gives a p-value at any level, where a bootstrap ends
at one over the number of its resamples.

Sources: B. Efron, R. Tibshirani (1993), An Introduction to the Bootstrap (influence and delta method); S. Holm
(1979), "A simple sequentially rejective multiple test procedure", Scand. J. Statistics 6, 65-70.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from filters.consistency.intervals import pooled_mean
from tuning.evaluation.evaluate import Evaluation

LEVEL = 0.05  # of a whole table: the chance that Holm's procedure calls any pair worse where none is


def chance_if_no_worse(a: Evaluation, b: Evaluation) -> float:
    """One-sided p-value: the chance of a ratio of scores a/b as large as this one, if a is no worse than b.

    1 where both made the same errors in each run.

    Args:
        a: a filter's errors on some seeds.
        b: the other one's on the same seeds.

    Raises:
        ValueError: if there are fewer than two runs.
    """
    if len(a.mean_squares) < 2:
        raise ValueError(f"a p-value needs at least two runs, but got {len(a.mean_squares)}")
    if np.array_equal(a.mean_squares, b.mean_squares):
        return 1.0
    (log_a, parts_a), (log_b, parts_b) = _influences(a), _influences(b)
    difference = parts_a - parts_b
    error = difference.std(ddof=1) / math.sqrt(len(difference))
    if not (math.isfinite(log_a - log_b) and error > 0):
        return 0.0 if log_a > log_b else 1.0
    from scipy.stats import t as student  # takes half a second

    return float(student.sf((log_a - log_b) / error, len(difference) - 1))


def holm(chances: Sequence[float], level: float = LEVEL) -> list[bool]:
    """Which of many p-values are significant together, by Holm's procedure.

    With m of them in increasing order, p_(1), ..., p_(m), those before the first with p_(k) > level/(m + 1 - k)
    are. Whatever their dependence, the chance that any is called so wrongly is at most `level`.
    """
    significant, count = [False] * len(chances), len(chances)
    for rank, index in enumerate(np.argsort(chances, kind="stable")):
        if chances[index] > level / (count - rank):
            break
        significant[index] = True
    return significant


def _influences(evaluation: Evaluation) -> tuple[float, np.ndarray]:
    """Logarithm of the score, and the influence of each run on it, (B,)."""
    counted = np.isfinite(evaluation.scale)
    squares, scale = evaluation.mean_squares[:, counted], evaluation.scale[counted]
    means = pooled_mean(squares, evaluation.weights)
    nonzero = means > 0  # a state without any error has no influence
    root = np.sqrt(means[nonzero]) * scale[nonzero]
    score = (np.sqrt(means) / scale).sum()
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = ((squares[:, nonzero] - means[nonzero]) / (2.0 * root * score)).sum(axis=1)
        logarithm = float(np.log(score))
    return (
        logarithm,
        parts if evaluation.weights is None else parts * evaluation.weights / evaluation.weights.mean(),
    )
