"""Scales of a model's states, in which steps of central differences and regions about a mean are measured."""

from __future__ import annotations

import warnings

import numpy as np

from thruster_env.core.checks import as_floats
from thruster_env.core.sources import as_value


def scales_of(model) -> np.ndarray:
    """Scale of each state of a model, (n,): its standard deviation in prior and Q together.

    Of a state without both it is how far others of a known scale move it in a step: a position whose velocity is
    uncertain. Else it is how far it moves by itself, or its prior mean's magnitude, or 1. So results do not depend
    on units.
    """
    scales = np.sqrt(np.diag(model.prior_cov) + np.diag(model.process_noise_cov))
    if (scales > 0.0).all():
        return scales
    start = _moved(model, model.prior_mean)
    shares = 0.75 + 0.25 * np.cos(np.arange(model.n))  # unequal, so that no two changes cancel
    for _ in range(model.n):
        reached = _sizes(_moved(model, model.prior_mean + shares * scales) - start)
        if not ((scales == 0.0) & (reached > 0.0)).any():
            break
        scales = np.where(scales > 0.0, scales, reached)
    for other in (_sizes(start - model.prior_mean), abs(model.prior_mean), np.ones(model.n)):
        scales = np.where(scales > 0.0, scales, other)
    return scales


def _sizes(changes: np.ndarray) -> np.ndarray:
    """Magnitudes of finite changes, and 0 for others."""
    return np.where(np.isfinite(changes), abs(changes), 0.0)


def _moved(model, x: np.ndarray) -> np.ndarray:
    """The state after x with inputs of zero, as Python has it; NaN where there is none."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            u = as_value([0.0] * model.inputs)
            found = as_floats(model.transition(as_value(x.tolist()), u, model.given_constants))
    except Exception:  # whatever a user's function raises; `model_check` says what is wrong
        return np.full(model.n, np.nan)
    return found if found.shape == x.shape else np.full(model.n, np.nan)
