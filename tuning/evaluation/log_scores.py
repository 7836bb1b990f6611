"""The log score of a filter: the log density of its belief at the true state, a proper score."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from filters.consistency.nees import sums_of_squares, whitened
from filters.engine.batch import Estimates
from filters.filter import Filter
from thruster_env.core.angles import difference, is_angle
from tuning.problems.data import Data

LEAST = -1e6  # log score of a step whose covariance is singular or not finite


def log_scores_of(
    filter_: Filter, estimates: Estimates, data: Data, scale: np.ndarray | Sequence[float] | None
) -> np.ndarray:
    """Log N(x; x^, P) of late steps, (B, T); NaN where a step is not scored, and without truth or covariance.

    The density is that of the states of finite scale alone. A step at which their P is singular or not finite
    has the lowest score, -1e6: a filter gains nothing by an invalid covariance.

    Args:
        filter_: the filter of the estimates.
        estimates: of all steps.
        data: of the same runs.
        scale: (n,), infinite for states that are not scored; None without truth.

    Source: Gneiting, Raftery (2007), "Strictly proper scoring rules, prediction, and estimation", JASA 102(477).
    """
    if data.states is None or scale is None or not filter_.has_covariance:
        return np.full(data.measurements[:, data.late].shape[:2], np.nan)
    places, late = np.flatnonzero(np.isfinite(scale)), data.late
    angles = [is_angle(place, filter_.model.shape.state_angles) for place in places.tolist()]
    covs = estimates.covs[:, late][..., places[:, None], places]
    with np.errstate(all="ignore"):
        errors = difference(estimates.means[:, late][..., places], data.states[:, late][..., places], angles)
        logarithms, squares = np.linalg.slogdet(covs)[1], sums_of_squares(whitened(errors, covs))
        found = -0.5 * (len(places) * math.log(2.0 * math.pi) + logarithms + squares)
    found = np.where(np.isfinite(found), np.maximum(found, LEAST), LEAST)
    return np.where(data.scored[:, late], found, np.nan)
