"""Outliers in logs: samples with large innovations of a robust filter are left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from filters.adaptive import RobustExtendedKalmanFilter
from filters.starts import Starts
from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from tuning.identification.objective import Objective
from tuning.identification.result import covariance, is_narrow
from tuning.identification.starts import estimates_of, runs_of
from tuning.problems.data import Data

ROUNDS = 30  # of leaving out and identifying again, at most; a narrow gate takes many


def outliers_of(model: StateSpaceModel, runs: Data, gate: float, starts: Starts | None = None) -> np.ndarray:
    """Which samples are outliers, (B, K + 1, m): innovations of more than `gate` standard deviations.

    The filter is an extended Kalman filter with Student-t noise (`filters.adaptive`): the normal one
    follows outliers, so that their neighbours would look like outliers, too.

    Args:
        model: the model of the filter.
        runs: inputs and measurements.
        gate: number of standard deviations.
        starts: of the runs, if some do not begin as the prior says.
    """
    estimates = estimates_of(model, runs, starts, RobustExtendedKalmanFilter)
    spread = np.sqrt(np.einsum("bkii->bki", estimates.innovation_covs))
    return np.abs(estimates.innovations) > gate * spread


class WithoutOutliers:
    """Data, or a function of parameters that returns them, without some samples."""

    def __init__(self, data: Data | Callable, outliers: np.ndarray):
        """Take the data of an `Objective`, and a mask (B, K + 1, m) of the samples to leave out."""
        self._data, self.outliers = data, outliers
        self.parameters = getattr(data, "parameters", ())
        noise_factors = getattr(data, "noise_factors", None)
        if noise_factors is not None:
            self.noise_factors = noise_factors

    def __call__(self, **values: float) -> Data:
        """The runs, NaN where a sample is left out."""
        runs = runs_of(self._data(**values) if callable(self._data) else self._data)
        return runs._replace(measurements=np.where(self.outliers, np.nan, runs.measurements))


def without_outliers(objective: Objective, outliers: np.ndarray, gate: float) -> Objective:
    """The same objective without the outliers, which are those beyond a gate."""
    return objective.with_changes(data=WithoutOutliers(objective.data, outliers), gate=gate)


# Whether logs excite the free parameters.


def check_excitation(objective: Objective, logs: Sequence[Log], start: np.ndarray) -> None:
    """Raise ValueError for logs with constant inputs that do not determine the free parameters.

    Args:
        objective: log-likelihood of the logs.
        logs: the logs as recorded.
        start: coordinates (p,) of the free parameters.

    Raises:
        ValueError: with the parameters that are not identifiable, by Fisher's information at the start.
    """
    levels = [np.ptp(log.inputs, axis=0) for log in logs]
    if any(level.any() for level in levels):
        return
    coordinates, evaluation = objective.coordinates, objective(start)
    cov = covariance(evaluation.information, evaluation.scores[:0], coordinates.high - coordinates.low)
    narrow = is_narrow(cov, coordinates)
    loose = [name for name, known in zip(coordinates.names, narrow, strict=True) if not known]
    if loose:
        raise ValueError(
            f"logs must excite the free parameters, but constant inputs do not determine {', '.join(loose)}: "
            "hold these, or record steps"
        )
