"""R and one factor on Q from innovations before and after updates, as Desroziers has it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuning.evaluation.baselines import with_covariances
from tuning.problems.in_parts import estimates_in_parts
from tuning.search.space import Choice
from tuning.ways.task import Task

ITERATIONS = 30
CLOSE = 1e-3  # relative change that ends it
MOST_CHANGE = 10.0  # factor on Q or R in an iteration


def desroziers(task: Task) -> None:
    """Repeat until neither R nor a factor on Q changes.

        R_jj <- mean of (R S^-1 d d')_jj,   Q <- Q (mean of d'd - tr R) / mean of tr(H P H')

    d is the innovation and R S^-1 d = z - H x_a what an update leaves of it: E[d_a d'] = R if both covariances are
    right. An iteration is one pass of the filter, of an ensemble as of a Kalman filter; where a filter has an
    inflation, it stays. Only what acts on the measurements is told: the proportions within Q stay, too.

    Source: Desroziers, Berre, Chapnik, Poli (2005), "Diagnosis of observation, background and analysis-error
    statistics in observation space", Quarterly J. Royal Meteorological Society 131(613).
    """
    choice = task.start
    for _ in range(ITERATIONS):
        moments = _moments(task, choice)
        task.charge(task.passes)
        if moments is None:
            return
        left, squares, spread = moments
        model = task.model(choice)
        r, q = model.measurement_noise_cov, model.process_noise_cov
        before = np.diag(r)
        after = before if task.options.get("hold_r") else np.clip(left, before / MOST_CHANGE, before * MOST_CHANGE)
        grown = np.sqrt(after / before)
        factor = float(np.clip((squares - after.sum()) / spread, 1.0 / MOST_CHANGE, MOST_CHANGE))
        choice = with_covariances(choice, factor * q, r * np.outer(grown, grown))
        task.keep(choice)
        if max(abs(np.log(factor)), abs(np.log(after / before)).max()) < CLOSE:
            return


def _moments(task: Task, choice: Choice) -> tuple[np.ndarray, float, float] | None:
    """Means over scored steps of (R S^-1 d d')_jj, (m,), d'd and tr(H P H'); None unless these are finite."""
    left: list[np.ndarray] = []
    totals: Sequence[list[np.ndarray]] = ([], [])
    for place, (problem, data) in enumerate(zip(task.problems, task.data, strict=True)):
        r = task.model(choice, place).measurement_noise_cov
        for some, found in estimates_in_parts(choice.filter(problem), data):
            there = some.scored & (~np.isnan(some.seen.measurements)).all(axis=-1)
            d, s = found.innovations[there], found.innovation_covs[there]
            whitened = np.linalg.solve(s, d[..., None])[..., 0]
            left.append((whitened @ r) * d)
            totals[0].append((d**2).sum(axis=-1))
            totals[1].append(np.trace(s - r, axis1=1, axis2=2))
    means = np.concatenate(left).mean(axis=0), *(float(np.concatenate(one).mean()) for one in totals)
    return means if all(np.isfinite(one).all() for one in means) and means[2] > 0 else None
