"""The log-likelihood of innovations, its gradient and its information along parameters of a whole model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.differentiated.recursion import Wanted
from filters.differentiated.runs import Density, ModelSlopes, derivatives
from filters.filter import Filter
from filters.likelihood import check_shapes
from filters.starts import Starts
from thruster_env.core.checks import as_floats
from thruster_env.model.state_space import StateSpaceModel


class Sensitivity(NamedTuple):
    """Log-likelihood of the innovations of B trajectories, its slopes along p parameters and their information."""

    values: np.ndarray  # (B,)
    gradients: np.ndarray  # (B, p)
    information: np.ndarray  # (B, p, p), Fisher's, as if the innovations had the covariances S
    block_gradients: np.ndarray  # (B, blocks, p), of the parts of each trajectory
    block_values: np.ndarray  # (B, blocks)


def sensitivity(
    model: StateSpaceModel,
    inputs: np.ndarray,
    measurements: np.ndarray,
    slopes: ModelSlopes,
    *,
    degrees: float = math.inf,
    blocks: int = 1,
    predicted: Sequence[bool] | None = None,
    starts: Starts | None = None,
    filter: Filter | None = None,
    own_slopes: np.ndarray | None = None,
) -> Sensitivity:
    """`likelihood`, and Fisher's information, for parameters that move all numbers of a model.

    Along a parameter the constants move by dc, and with them f, h and their Jacobians: exactly, where the model's
    functions can be traced, else by central differences, whose steps are relative to |c| + |dc|. So a unit of a
    parameter should be a sensible amount of it, as a hundredth of its range or the unit of its logarithm.

    Args:
        model: the model at which slopes are taken.
        inputs: (B, K, p).
        measurements: (B, K + 1, m); NaN where missing.
        slopes: how the model changes along each parameter.
        degrees: degrees of freedom of a Student-t density with the covariance S in place of the normal one, which
            outliers move less; above 2. The filter stays as it is.
        blocks: number of equal parts of each trajectory, whose values and gradients are returned separately.
        predicted: (m,) which channels the filter only predicts, after it has seen the others, and is never updated
            with: such as a load cell that is there for the identification only. Their prediction errors enter as
            innovations do. As nothing corrects them, they are correlated in time, and the information is
            overestimated.
        starts: of trajectories that do not begin at the prior: parameters do not move their priors (unless these
            are not held), and the innovations of their lead-ins do not count. The likelihood is that of the other
            measurements, given the lead-ins.
        filter: as `likelihood` takes it; the (extended) Kalman filter by default.
        own_slopes: as `likelihood` takes them.

    Raises:
        ValueError: if shapes do not fit, degrees are not above 2, or for another filter.

    Source: Gupta, Mehra (1974), as `likelihood`; Astrom (1980), "Maximum likelihood and prediction error methods",
    Automatica 16(5), for the information.
    """
    if not degrees > 2:
        raise ValueError(f"degrees of freedom must be above 2, but got {degrees!r}")
    inputs, measurements = (np.ascontiguousarray(as_floats(a)) for a in (inputs, measurements))
    slopes = ModelSlopes(*(np.ascontiguousarray(slope, dtype=np.float64) for slope in slopes))
    n, m, p = model.n, model.m, len(slopes.constants)
    arrays = {"inputs": inputs, "measurements": measurements, **slopes._asdict()}
    check_shapes(arrays, model, (p, len(model.constants)), (p, n, n), (p, m, m), (p, n), (p, n, n))
    counts = 1.0 - np.array(np.zeros(m) if predicted is None else predicted, dtype=np.float64)
    if counts.shape != (m,):
        raise ValueError(f"predicted must be true or false for each of {m} channels, but got {predicted!r}")
    wanted = Wanted(information=True, constants=True, tails=True)
    density = Density(float(degrees), counts)
    out, information = derivatives(
        *(model, inputs, measurements, slopes, wanted),
        density=density,
        blocks=blocks,
        starts=starts,
        used=filter,
        own_slopes=own_slopes,
    )
    total = out.sum(axis=1)
    return Sensitivity(total[:, 0], total[:, 1:], information, out[:, :, 1:], out[:, :, 0])
