"""Trials that are enqueued unless there is one with the same parameters."""

from __future__ import annotations

import math
from numbers import Real

import optuna

NEAR = 2e-5  # relative difference of parameters, above which trials are certainly not equal


def enqueue_new(study: optuna.Study, parameters: dict, attributes: dict) -> None:
    """Enqueue a trial unless there is one with these parameters.

    Optuna compares it with all trials, one parameter at a time by NumPy: so it is asked only where one is near.
    """
    trials = study.get_trials(deepcopy=False)
    near = any(not trial.state.is_finished() or is_near(trial.params, parameters) for trial in trials)
    study.enqueue_trial(parameters, user_attrs=attributes, skip_if_exists=near)


def is_near(parameters: dict, other: dict) -> bool:
    """Whether no parameter that both have differs by more than what Optuna takes as equal, 1e-5."""
    for name, value in other.items():
        if isinstance(value, Real) and isinstance(parameters.get(name, ""), Real):
            if not math.isclose(value, parameters[name], rel_tol=NEAR):
                return False
        elif name in parameters and parameters[name] != value:
            return False
    return True
