"""Whether logs excite the free parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thruster_env.logs.log import Log
from tuning.identification.objective import Objective
from tuning.identification.result import covariance, is_narrow


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
    coordinates, found = objective.coordinates, objective(start)
    cov = covariance(found.information, found.scores[:0], coordinates.high - coordinates.low)
    narrow = is_narrow(cov, coordinates)
    loose = [name for name, known in zip(coordinates.names, narrow, strict=True) if not known]
    if loose:
        raise ValueError(
            f"logs must excite the free parameters, but constant inputs do not determine {', '.join(loose)}: "
            "hold these, or record steps"
        )
