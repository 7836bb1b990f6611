"""Does a model blow up between samples? Then its predictions are off by more than any Q or R explains."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

BLOW_UP = 1e3  # spreads of a channel: no Q or R explains a prediction that is so far off


def root_mean_square(values: np.ndarray) -> float:
    """Root mean square of the values that are not NaN, infinite only if one of them is; NaN of none."""
    there = values[~np.isnan(values)]
    if not there.size:
        return np.nan
    largest = float(abs(there).max()) or 1.0  # by which squares stay finite where a model blows up
    return float(np.sqrt(((there / largest) ** 2).mean()) * largest) if isfinite(largest) else np.inf


def blow_up_sentence(
    innovations: np.ndarray, measurements: np.ndarray, names: Sequence[str], dt: float | None = None
) -> str:
    """A sentence on a model that blows up between samples; empty where it does not.

    That is where a channel's root mean square innovation is a thousand times its standard deviation.

    Args:
        innovations: (..., m), NaN where they do not count.
        measurements: (..., m), NaN where missing.
        names: of the channels.
        dt: sample time [s], if there is one.
    """
    for place, name in enumerate(names):
        rmse, z = root_mean_square(innovations[..., place]), measurements[..., place]
        if np.isnan(rmse) or np.isnan(z).all():
            continue
        spread = float(np.nanstd(z))
        if rmse > BLOW_UP * spread:
            time = "this dt" if dt is None else f"dt = {dt:g} s"
            return (
                f"The model diverges between samples: its prediction of {name} is off by {rmse:.3g}, and "
                f"{spread:.3g} is the channel's standard deviation. Its integration step is too long for "
                f"{time}: give the model more substeps or the data a smaller dt, and check that the "
                "model's time is in seconds, as that of the data is."
            )
    return ""
