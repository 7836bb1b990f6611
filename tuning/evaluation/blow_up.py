"""Whether a filter's model blows up between samples, by its innovations on a problem's data."""

from __future__ import annotations

from filters.consistency.nees import blow_up_sentence
from filters.engine.batch import Estimates
from filters.filter import Filter
from tuning.problems.data import Data, estimates_in_parts

RUNS = 20  # that tell


def blow_up(filter_: Filter, estimates: Estimates, data: Data, dt: float | None) -> str:
    """A sentence on a filter whose model blows up between samples, from its scored innovations; empty otherwise.

    Args:
        filter_: the filter of the estimates.
        estimates: on the same data.
        data: inputs and measurements.
        dt: sample time [s], if there is one.
    """
    names = [channel.name for channel in filter_.model.measurements]
    innovations, measurements = (data.late_scored(values) for values in (estimates.innovations, data.measurements))
    return blow_up_sentence(innovations, measurements, names, dt)


def blow_up_on(filter_: Filter, data: Data, dt: float | None) -> str:
    """`blow_up` of a filter on the first runs of some data."""
    first_runs = data.slice(0, RUNS)
    sentences = [
        blow_up(filter_, estimates, part, dt) for part, estimates in estimates_in_parts(filter_, first_runs)
    ]
    return next((sentence for sentence in sentences if sentence), "")
