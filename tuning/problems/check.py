"""Checks of a problem: its model and its data must agree in shapes, names and units."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from weakref import WeakValueDictionary

import numpy as np

from thruster_env.core.checks import short_repr
from thruster_env.core.sources import as_value
from thruster_env.model.quantities import Quantities, Quantity
from thruster_env.model.simulate import seconds_as_python
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.data import Data
from tuning.problems.problem import Problem

SEEDS = (0, 1)  # with which a problem is checked
A_MINUTE, RUNS = 60.0, 100  # [s], and of how many runs
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
    """Warn if the model runs as Python, so that a filter with differences takes over a minute for RUNS."""
    steps = data.inputs.shape[1]
    seconds = seconds_as_python(model) * (1 + 2 * model.n) * RUNS * steps
    if seconds > A_MINUTE:
        warnings.warn(
            f"the model of problem {name} runs as Python: a filter may take {seconds / 60:.0f} min for {RUNS} "
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
        "measurements": (count, steps + 1, model.m),
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
    if scale.shape != data.states.shape[-1:] or not (scale > 0).all() or not np.isfinite(scale).any():
        raise ValueError(
            f"scale of problem {name} must be {data.states.shape[-1]} positive numbers, infinite for states "
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
