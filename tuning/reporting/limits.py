"""Axes of panels over time: limits from the scored steps, so that a start-up does not flatten the rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FAR = 20.0  # where one panel of a row reaches so many times as far as another each has its own limits
WIDEST = 4.0  # times the largest error: how much of a band is shown
ROOM = 0.08  # of what is shown, above and below
NOTE = {"xycoords": "axes fraction", "fontsize": 8, "zorder": 5}


def limit_errors(
    axes: Sequence, values: Sequence[np.ndarray], bands: Sequence[np.ndarray], start: int, word: str = "RMSE"
) -> None:
    """Limits of a row of errors or innovations in their bands, symmetric, and the RMSE in each panel.

    Args:
        axes: of the row, a filter each.
        values: of each filter (K + 1,), NaN where there is none.
        bands: half widths beside them.
        start: the first scored step; earlier ones may leave the panel.
        word: for the root of the mean square.
    """
    reaches = [_reach(*pair, start) for pair in zip(values, bands, strict=True)]
    known = [reach for reach in reaches if reach > 0]
    differ = len(known) > 1 and max(known) >= FAR * min(known)
    for place, (axis, of_filter, reach) in enumerate(zip(axes, values, reaches, strict=True)):
        limit = (reach if differ else max(known, default=0.0)) * (1.0 + ROOM)
        if limit > 0:
            axis.set_ylim(-limit, limit)
        before, scored = of_filter[:start], of_filter[start:]
        scored = scored[np.isfinite(scored)]
        clipped = "; start-up is cut off" if limit > 0 and (np.abs(before) > limit).any() else ""
        said = f"{word} {np.sqrt(np.mean(scored**2)):.3g}{clipped}" if scored.size else clipped.strip("; ")
        box = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 1.0}
        axis.annotate(said, (0.995, 0.97), ha="right", va="top", bbox=box, **NOTE)
        if differ:
            axis.annotate("axes differ", (0.01, 0.97), ha="left", va="top", bbox=box, **NOTE)
        elif place:
            axis.tick_params(labelleft=False)


def limit_values(axes: Sequence, plotted: Sequence[np.ndarray], bands: Sequence[np.ndarray]) -> None:
    """One pair of limits for a row of estimates: everything shown, and at most as much again of the bands.

    Args:
        axes: of the row, a filter each.
        plotted: truth and estimates, as far as they have to be seen.
        bands: their ends.
    """
    ends = _ends(plotted)
    if ends is None:
        return
    low, high = ends
    span = high - low or abs(high) or 1.0
    edge = _ends(bands) or ends
    low, high = max(min(low, edge[0]), low - span), min(max(high, edge[1]), high + span)
    for place, axis in enumerate(axes):
        axis.set_ylim(low - ROOM * span, high + ROOM * span)
        if place:
            axis.tick_params(labelleft=False)


def _ends(series: Sequence[np.ndarray]) -> tuple[float, float] | None:
    """The least and the largest of all finite values."""
    found = np.concatenate([one[np.isfinite(one)] for one in series])
    return (float(found.min()), float(found.max())) if found.size else None


def _reach(values: np.ndarray, band: np.ndarray, start: int) -> float:
    """The range of a panel: to the largest error, and to the end of a band not far beyond."""
    (_, error), (_, width) = (_ends([np.abs(one[start:])]) or (0.0, 0.0) for one in (values, band))
    return max(error, min(width, WIDEST * error) if error > 0 else width)
