"""Estimates of thrust on the recorded runs: ours, the recorder's own, and trivial ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tuning.experiments.recordings.identification import CHOSEN, STRUCTURES, thrusts
from tuning.experiments.recordings.measure import Ratios, ratios
from tuning.experiments.recordings.model import model
from tuning.experiments.recordings.results import Task
from tuning.experiments.recordings.runs import Recording

OURS, OWN, DESIRED, STATIC, LOOKUP = "ours", "recorder's", "desired", "static map", "lookup"
# Least squares on the table of steady states of the same source, ahead and astern.
STATIC_FACTORS = 0.968e-3, 0.979e-3  # T = c n|n| [N s^2]
LOOKUP_FACTORS, LOOKUP_BAND = (2.51, 2.62), 0.84  # T = k (|u| - 0.84)^2 [N/V^2, V]


def estimates_of(runs: Sequence[Recording], held_out: Mapping[str, Mapping] | None = None) -> dict[str, list]:
    """Thrust (K + 1,) on each run by every estimator, by name.

    Args:
        runs: recorded.
        held_out: tasks by name (`results.identify_all`): our estimate of a run then has the parameters that were
            identified without this run. If None those of `identified.toml`.
    """
    ours = thrusts(model(), runs) if held_out is None else left_out(CHOSEN, runs, held_out)
    return {
        OURS: ours,
        OWN: [run.own for run in runs],
        DESIRED: [run.desired for run in runs],
        STATIC: [_static(run) for run in runs],
        LOOKUP: [_lookup(run) for run in runs],
    }


def left_out(structure: str, runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[np.ndarray]:
    """Thrust on each run by a structure that was identified without that run."""
    one, found = STRUCTURES[structure], []
    for run in runs:
        values = tasks[Task(structure, run.name).name]["values"]
        found += thrusts(one.model(**values), [run], one.ambient)
    return found


def structure_ratios(structure: str, runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[Ratios]:
    """Ratios to the recorder's own estimate on each run, left out of the identification."""
    return [ratios(one, run) for one, run in zip(left_out(structure, runs, tasks), runs, strict=True)]


def _static(run: Recording) -> np.ndarray:
    """From the tachometer with the sign of the previous command."""
    sign = np.sign(np.append(0.0, run.command[:-1]))
    speed = sign * np.nan_to_num(run.tachometer)
    return np.where(speed > 0, *STATIC_FACTORS) * speed * abs(speed)


def _lookup(run: Recording) -> np.ndarray:
    """From the previous command."""
    command = np.append(0.0, run.command[:-1])
    beyond = np.maximum(abs(command) - LOOKUP_BAND, 0.0)
    return np.sign(command) * np.where(command > 0, *LOOKUP_FACTORS) * beyond**2
