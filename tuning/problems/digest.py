"""A problem's digest: a short hash of its numbers, by which two processes check that they have the same problem.

The numbers are the data of four seeds, the assumed model at its defaults and at the ends of its parameters, and
the values of f and h along these data. Whatever changes them by a millionth of their range changes the digest;
how the code is written, where it stands and what it is called does not. It cannot tell apart

- problems that differ only beyond these runs, as by an event of one seed in a hundred, or in what f and h do for
  states and inputs that neither the data nor the fixed points of `StateSpaceModel.digest` reach;
- functions that make the same model at the defaults and where one parameter is at an end, and another between;
- what only other results follow from, as a model's own Jacobians.

Where a run amplifies rounding, as of a chaotic plant, another processor has other data and another digest.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from thruster_env.core.sources import as_value
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.data import Data

RUNS = 4  # whose data count
POINTS = 100  # of these data, at most, at which f and h are evaluated
LENGTH = 16  # hexadecimal digits of a SHA-256 that are kept; digests of code, which this one replaces, had twelve
STEPS = 1e6 * np.sqrt(0.5)  # in the largest value of a column; irrational, so that round values are at no edge
OF_MODEL = (
    "process_noise_cov",
    "measurement_noise_cov",
    "prior_mean",
    "prior_cov",
    "operating_state",
    "operating_input",
    "state_low",
    "state_high",
    "bounds",
    "constants",
)  # beside what `StateSpaceModel.digest` covers


def digest_of(*values: Any) -> str:
    """A hash of texts, numbers, collections of these, dataclasses, arrays (..., n) and models.

    The columns of arrays are rounded to a millionth of their largest value.
    """
    text = json.dumps(_plain(values), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:LENGTH]


def is_older(stored: Any, digest: Any) -> bool:
    """Whether a stored digest is one of code, which says nothing of one of numbers, or a collection has one."""
    if isinstance(stored, Mapping) and isinstance(digest, Mapping):
        return any(is_older(stored[key], digest[key]) for key in stored.keys() & digest.keys())
    if isinstance(stored, list) and isinstance(digest, list):
        return any(map(is_older, stored, digest))
    return isinstance(stored, str) and isinstance(digest, str) and len(stored) < len(digest) == LENGTH


def numbers_of(models: Sequence[StateSpaceModel | None], data: Data) -> list:
    """What `digest_of` takes of assumed models and data: all numbers of both, and f and h along the data."""
    arrays = data.inputs, data.measurements, data.states, data.outputs, data.counted
    return [arrays, data.first_scored, [model and (model, *_along(model, data)) for model in models]]


def _along(model: StateSpaceModel, data: Data) -> tuple[np.ndarray, list[str]]:
    """Values of f and h at some true states and inputs of data, (points, n + m), and the errors that they raise.

    States that are unknown are those of the prior's mean.
    """
    inputs, c, rows, errors = data.seen.inputs, model.given_constants, [], []
    chosen = np.unique(np.linspace(0, inputs.shape[0] * inputs.shape[1] - 1, POINTS).astype(int))
    for run, k in zip(*np.unravel_index(chosen, inputs.shape[:2]), strict=True):
        state = model.prior_mean.copy()
        if data.states is not None:
            known = data.states[run, k]
            state[: len(known)] = np.where(np.isfinite(known), known, state[: len(known)])
        x, u = as_value(state.tolist()), as_value(inputs[run, k].tolist())
        try:
            with np.errstate(all="ignore"):
                parts = model.transition(x, u, c), model.observe(x, *([u] if model.feeds else []), c)
                rows.append(np.concatenate([np.array(part, dtype=np.float64) for part in parts]))
        except Exception as error:  # undefined there, which is as good as a number
            errors.append(type(error).__name__)
    return np.array(rows).reshape(len(rows), -1), errors


def _plain(value: Any) -> Any:
    """A value as JSON can hold it, arrays rounded."""
    if isinstance(value, StateSpaceModel):
        return [value.digest, *(_plain(getattr(value, name)) for name in OF_MODEL)]
    if isinstance(value, np.ndarray | np.generic):
        return _rounded(np.asarray(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, tuple | list | range):
        return [_plain(part) for part in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, *(_plain(getattr(value, part.name)) for part in dataclasses.fields(value))]
    if isinstance(value, float):
        return _significant(value)
    return value if value is None or isinstance(value, bool | int | str) else type(value).__qualname__


def _significant(value: float) -> str:
    """A number without the digits in which processors differ."""
    return f"{value:.12g}"


def _rounded(array: np.ndarray) -> list:
    """Shape, largest magnitude of each column, and a hash of the multiples of a part of it."""
    columns = np.atleast_1d(array).astype(np.float64)
    columns = columns.reshape(-1, columns.shape[-1]) if columns.size else columns.reshape(0, 1)
    finite = np.where(np.isfinite(columns), np.abs(columns), 0.0)
    largest = finite.max(axis=0, initial=0.0)
    with np.errstate(invalid="ignore"):
        multiples = np.round(columns / np.where(largest > 0, largest, 1.0) * STEPS)
    multiples = np.where(np.isnan(multiples), np.inf, multiples + 0.0)  # missing; and no zero with a sign
    text = hashlib.sha256(np.ascontiguousarray(multiples).tobytes()).hexdigest()
    return [list(array.shape), [f"{value:.6g}" for value in largest], text]
