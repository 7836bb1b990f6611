"""Outliers in logs: samples that a robust filter of the identified model finds far off are left out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from filters.adaptive.robust import RobustExtendedKalmanFilter
from filters.engine.batch import run
from plants.state_space import StateSpaceModel
from tuning.identification.objective import Objective
from tuning.identification.runs import runs_of
from tuning.problems.data import Data

ROUNDS = 6  # of leaving out and identifying anew, at most


def outliers_of(model: StateSpaceModel, runs: Data, gate: float) -> np.ndarray:
    """Which samples are outliers, (B, K + 1, m): innovations beyond so many standard deviations of their channel.

    The filter is the extended one with Student-t noise (`filters.adaptive.robust`): an outlier that the normal one
    follows would make its neighbours look like outliers, too.

    Args:
        model: as the filter runs on it.
        runs: of the model's inputs and measurements.
        gate: standard deviations.
    """
    found = run(RobustExtendedKalmanFilter(model=model), runs.filter_keys, runs.inputs, runs.measurements)
    spread = np.sqrt(np.einsum("bkii->bki", found.innovation_covs))
    return np.abs(found.innovations) > gate * spread


class WithoutOutliers:
    """Data, or a function of parameters that gives these, without some samples."""

    def __init__(self, data: Data | Callable, outliers: np.ndarray):
        """Take what `Objective` takes, and which samples (B, K + 1, m) are left out."""
        self._data, self.outliers = data, outliers
        self.parameters = getattr(data, "parameters", ())
        if hasattr(data, "noise_factors"):
            self.noise_factors = data.noise_factors

    def __call__(self, **values: float) -> Data:
        """The runs, NaN where a sample is left out."""
        runs = runs_of(self._data(**values) if callable(self._data) else self._data)
        return runs._replace(measurements=np.where(self.outliers, np.nan, runs.measurements))


def without_outliers(objective: Objective, outliers: np.ndarray) -> Objective:
    """The same objective, of the samples that are no outliers."""
    return objective.with_changes(data=WithoutOutliers(objective.data, outliers))
