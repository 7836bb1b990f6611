"""Checks of a problem: its model and its data must agree, and two processes must have the same problem.

The latter check its digest, a short hash of its numbers. These are the data of four seeds, the assumed model at
its defaults and at the ends of its parameters, and the values of f and h along these data. Whatever changes them
by a millionth of their range changes the digest; how the code is written, where it stands and what it is called
does not. It cannot tell apart

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
import warnings
from collections.abc import Mapping, Sequence
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from thruster_env.core.checks import short_repr
from thruster_env.core.sources import as_value
from thruster_env.model.quantities import Quantities, Quantity
from thruster_env.model.simulate import seconds_as_python
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import tangent_of
from tuning.problems.data import Data
from tuning.problems.problem import Problem

SEEDS = (0, 1)  # with which a problem is checked
A_MINUTE, MANY = 60.0, 100  # [s], and of how many runs
_CHECKED: WeakValueDictionary[int, Problem] = WeakValueDictionary()  # problems that were checked, by their ids


def checked_problem(problem, name: str | None = None) -> Problem:
    """The same problem, checked with the data of two seeds; once for each object.

    Args:
        problem: the object to check.
        name: its name in messages; its own name if None.

    Raises:
        ValueError: in one line, for an object that is not a `Problem`, or a problem whose model, data, names,
            units or scale do not agree, or whose numbers are not finite.
    """
    if not isinstance(problem, Problem):
        raise ValueError(
            f"a problem must be a tuning.problems.problem.Problem, but {short_repr(name)} is {short_repr(problem)}"
        )
    name = problem.name if name is None else name
    if _CHECKED.get(id(problem)) is problem:
        return problem
    model = problem.model(**problem.untuned)
    if not isinstance(model, StateSpaceModel):
        raise ValueError(f"the model of problem {name} must be a StateSpaceModel, but it is {short_repr(model)}")
    for kind, quantities, model_quantities in zip(
        Quantities._fields, problem.quantities, model.quantities, strict=True
    ):
        check_quantities(
            kind.removesuffix("_quantities"), quantities, model_quantities, f"problem {name}", "its model"
        )
    data = problem.data(SEEDS)
    check_data(data, model, name)
    check_model(model, data, name)
    _check_scale(problem, data, name)
    _tell_of_python(data, model, name)
    _CHECKED[id(problem)] = problem
    return problem


def _tell_of_python(data: Data, model: StateSpaceModel, name: str) -> None:
    """Warn if the model runs as Python, so that a filter with differences takes over a minute for MANY."""
    steps = data.inputs.shape[1]
    seconds = seconds_as_python(model) * (1 + 2 * model.n) * MANY * steps
    if seconds > A_MINUTE:
        warnings.warn(
            f"the model of problem {name} runs as Python: a filter may take {seconds / 60:.0f} min for {MANY} "
            f"runs of {steps} steps, in each trial of a study",
            stacklevel=3,
        )


def data_of(problem: Problem, seeds: Sequence[int]) -> Data:
    """A problem's data of some seeds, checked, for they may be off where those of the first seeds are not."""
    data = problem.data(seeds)
    check_data(data, problem.model(), problem.name)
    return data


def check_data(data: Data, model: StateSpaceModel, name: str) -> None:
    """Raise ValueError unless data have the shapes of a model and are finite; measurements may be NaN."""
    count, steps = len(data.seeds), np.shape(data.inputs)[1] if np.ndim(data.inputs) == 3 else 0
    wanted = {
        "inputs": (count, steps, model.inputs),
        "measurements": (count, steps + 1, model.channels),
        "filter_keys": (count, 2),
    }
    parts = {entry: getattr(data, entry) for entry in wanted}
    if data.counted is not None:
        _check_counted(data, (count, steps + 1), name)
    if data.states is not None:
        known = np.shape(data.states)[-1] if np.ndim(data.states) == 3 else 0
        parts["states"], wanted["states"] = data.states, (count, steps + 1, min(max(known, 1), model.n))
    for entry, array in (data.outputs or {}).items():
        parts[f"output {entry}"], wanted[f"output {entry}"] = array, (count, steps + 1)
    for entry, array in parts.items():
        if isinstance(array, np.ma.MaskedArray):
            raise ValueError(
                f"{entry} of problem {name} must be a plain array, NaN where something is missing, "
                "but got a masked one"
            )
        if np.shape(array) != wanted[entry]:
            raise ValueError(
                f"{entry} of problem {name} must have the shape {wanted[entry]} of its model, "
                f"but got {np.shape(array)}"
            )
        finite = np.isfinite(array) if entry != "measurements" else ~np.isinf(array)
        if entry != "filter_keys" and data.counted is not None:
            finite |= _not_there(data, entry, finite)
        if not finite.all():
            rule = "finite or NaN" if entry == "measurements" else "finite"
            run, step, *index = np.argwhere(~finite)[0]
            raise ValueError(
                f"{entry} of problem {name} must be {rule}, but those of seed {data.seeds[run]} are not from step "
                f"{step} on{_before(array[run], step, index, model) if entry == 'states' else ''}"
            )
    if not 0 <= data.first_scored <= steps:
        raise ValueError(
            f"first_scored of problem {name} must be from 0 to the number of steps, {steps}, "
            f"but got {data.first_scored}"
        )
    for seed, scored in zip(data.seeds, data.scored_counts, strict=True):
        if not scored:
            raise ValueError(
                f"each run of problem {name} must have a step that is scored, from {data.first_scored} on, "
                f"with a truth if the problem has one, but that of seed {seed} has none"
            )


def _check_counted(data: Data, shape: tuple[int, int], name: str) -> None:
    counted = np.asarray(data.counted)
    if counted.shape != shape or counted.dtype != bool:
        raise ValueError(
            f"counted of problem {name} must be bool and of shape {shape}, one per measurement, but got "
            f"{counted.dtype} of shape {counted.shape}"
        )


def _not_there(data: Data, entry: str, values: np.ndarray) -> np.ndarray:
    """Where values of an entry may be anything: truth where a step does not count, all in padding."""
    times = np.arange(values.shape[1])
    if entry in ("inputs", "measurements"):
        unseen = times + (entry == "inputs") >= data.rows[:, None]
    else:
        unseen = ~np.asarray(data.counted)
    return unseen.reshape(unseen.shape + (1,) * (values.ndim - 2))


def _before(states: np.ndarray, step: int, index: Sequence, model: StateSpaceModel) -> str:
    """The first state of a run (K+1, n) that is not finite, its value one step earlier, and why."""
    state = model.states[index[0]]
    unit = f" {state.unit}" if state.unit else ""
    value = f"{state.symbol} was {states[step - 1, index[0]]:.4g}{unit} one step earlier" if step else state.symbol
    return f": {value}; a root or a logarithm may have left its domain, or the plant is unstable"


def check_model(model: StateSpaceModel, data: Data, name: str) -> None:
    """Raise ValueError unless f and h of a model are finite at the first states of the data."""
    points = {"its prior mean": model.prior_mean}
    if data.states is not None and data.states.shape[-1] == model.n:
        points["the first true state"] = data.counted_rows(data.states)[0]
    control = as_value(data.inputs[0, 0].tolist() if data.steps else [0.0] * model.inputs)
    for where, point in points.items():
        x, c = as_value(point.tolist()), model.given_constants
        functions = {
            "transition": lambda x=x, c=c: model.transition(x, control, c),
            "observe": lambda x=x, c=c: model.observe(x, *model.any_shape.fed(control), c),
        }
        for function, value in functions.items():
            got: ArithmeticError | tuple
            try:
                with np.errstate(all="ignore"):
                    result = np.asarray(value(), dtype=np.float64)
                if np.isfinite(result).all():
                    continue
                got = tuple(result.tolist())
            except ArithmeticError as error:
                got = error
            raise ValueError(f"{function} of the model of problem {name} must be finite at {where}, but got {got}")


def _check_scale(problem: Problem, data: Data, name: str) -> None:
    if data.states is None or problem.scale is None:
        if data.states is not None or problem.scale is not None:
            raise ValueError(f"problem {name} must have a scale if, and only if, its data have a truth")
        return
    scale = np.asarray(problem.scale, dtype=np.float64)
    count = len(tangent_of(problem.model(), data.states.shape[-1]))
    if scale.shape != (count,) or not (scale > 0).all() or not np.isfinite(scale).any():
        raise ValueError(
            f"scale of problem {name} must be {count} positive numbers, infinite for states "
            f"that are not scored, but got {short_repr(problem.scale)}"
        )


def check_quantities(
    kind: str, quantities: tuple[Quantity, ...], reference: tuple[Quantity, ...], owner: str, other: str
) -> None:
    """Raise ValueError, with the first difference, unless two vectors have the same symbols and units.

    Args:
        kind: what the vectors are, such as "measurements".
        quantities: quantities of the first vector.
        reference: those of the second.
        owner: owner of the first vector, for messages ...
        other: ... and of the second.
    """
    if len(quantities) != len(reference):
        raise ValueError(
            f"{kind} of {owner} and {other} must be as many, but got {_listed(quantities)} and "
            f"{_listed(reference)}"
        )
    for quantity, expected in zip(quantities, reference, strict=True):
        if (quantity.symbol, quantity.unit, quantity.angle) != (expected.symbol, expected.unit, expected.angle):
            raise ValueError(
                f"{kind} of {owner} and {other} must have the same symbols and units, "
                f"but got {_in_words(quantity)} and {_in_words(expected)}"
            )


def _listed(quantities: tuple[Quantity, ...]) -> str:
    return f"{len(quantities)} ({', '.join(quantity.symbol for quantity in quantities)})"


def _in_words(quantity: Quantity) -> str:
    return f"{quantity.symbol} [{quantity.unit}]" + (" (an angle)" if quantity.angle else "")


DIGEST_RUNS = 4  # whose data count
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
