"""Check that a model's functions take and return the declared shapes: one call, as Python, at the prior mean."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thruster_env.core.checks import as_floats, short_repr
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.modules import error_line
from thruster_env.core.sources import as_value, is_array
from thruster_env.graphs.python_floats import with_floats


def checked_constants(constants) -> tuple:
    """Return constants as a NamedTuple, as it is given, or a tuple of floats; raise ValueError for others."""
    try:
        if isinstance(constants, (dict, set, str)):
            raise ValueError
        values = as_floats(tuple(constants))
        if values.ndim != 1 or not np.isfinite(values).all():
            raise ValueError
    except (TypeError, ValueError):
        rule = "constants must be a NamedTuple or a tuple of finite numbers"
        raise ValueError(f"{rule}, but got {short_repr(constants)}") from None
    return constants if hasattr(constants, "_fields") else tuple(values.tolist())


def check_functions(model) -> None:
    """Raise ValueError unless a model's f and h, and their Jacobians if given, have the shapes of its numbers."""
    n, m = model.n, model.m
    states, measured = _count(n, "state"), _count(m, "measurement")
    by_states, by_noise = f"as prior_mean has {n}", f"as measurement_noise_cov is {m} x {m}"
    rules = {
        "transition": ("x, u, c", (n,), f"a tuple{_or_array(n)} of {states}, {by_states}"),
        "observe": ("x, c", (m,), f"a tuple{_or_array(m)} of {measured}, {by_noise}"),
        "transition_jacobian": ("x, u, c", (n, n), f"{_count(n, 'row')} of {n}, {by_states}"),
        "observe_jacobian": ("x, c", (m, n), f"{_count(m, 'row')} of {n}, {by_noise}"),
    }
    for name, (arguments, shape, rule) in rules.items():
        function = getattr(model, name)
        if function is not None:
            _check_arguments(name, function, arguments)
            _check_result(name, function, model, arguments, shape, rule)


def _refuse_slopes(name: str, model, arguments: str, value_text: str) -> None:
    """Raise ValueError for a Jacobian that is not finite at the prior mean, if its function is."""
    function = getattr(model, name.removesuffix("_jacobian"))
    try:
        with np.errstate(all="ignore"):
            value = as_floats(function(*_arguments(arguments, model, model.prior_mean)))
    except (ArithmeticError, ValueError):
        return
    if np.isfinite(value).all():
        raise ValueError(
            f"{name} must be finite at the prior mean with inputs of zero, as its function is, but got "
            f"{value_text}: return a limit there, or leave it out"
        )


def _arguments(names: str, model, x: np.ndarray) -> list:
    arguments = {
        "x": as_value(x.tolist()),
        "u": as_value([0.0] * model.inputs),
        "c": model.given_constants,
    }
    return with_floats(float, [arguments[name] for name in names.split(", ")])


def _check_arguments(name: str, function: Callable, arguments: str) -> None:
    if not callable(function):
        raise ValueError(f"{name} must be a function of ({arguments}), but got {short_repr(function)}")
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some are written in C
        return
    try:
        signature.bind(*arguments.split(", "))
    except TypeError:
        raise ValueError(f"{name} must be a function of ({arguments}), but takes {signature}") from None


def _place(function: Callable) -> str:
    """Name, file and line of a function, in brackets; empty without a file, as for generated code."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    if code is None or not Path(code.co_filename).is_file():
        return ""
    return f" (function {function.__name__}, {Path(code.co_filename).name} line {code.co_firstlineno})"


def _check_result(name: str, function: Callable, model, arguments: str, shape: tuple, rule: str) -> None:
    for point in (model.prior_mean, model.prior_mean + model.scales):
        at_mean, slopes = point is model.prior_mean, name.endswith("jacobian")
        must_be_known = at_mean and not slopes
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("error", np.exceptions.ComplexWarning)  # of a derivative that is lost
                result = function(*_arguments(arguments, model, point))
        except ArithmeticError as error:  # machine code has infinity there
            if at_mean and slopes:
                _refuse_slopes(name, model, arguments, error_line(error))
            continue
        except Exception as error:
            if str(error).startswith("math "):  # "math domain error", where machine code has NaN
                if must_be_known:
                    raise ValueError(_not_nan(name, str(error))) from None
                if at_mean:
                    _refuse_slopes(name, model, arguments, str(error))
                continue
            sizes = f"{_count(model.n, 'state')}{_form(model.n)} and {_count(model.inputs, 'input')}"
            where = _place(function)
            raise ValueError(f"{name}{where} must work for {sizes}, but raised {error_line(error)}") from error
        result_shape = _shape(result)
        if result_shape != shape:
            raise ValueError(f"{name} must return {rule}, but returned {_said(result_shape, result)}")
        if must_be_known and np.isnan(as_floats(result)).any():
            raise ValueError(_not_nan(name, short_repr(result)))
        if at_mean and slopes and not by_complex_step(function) and not np.isfinite(as_floats(result)).all():
            _refuse_slopes(name, model, arguments, short_repr(result))
        return


def _not_nan(name: str, value_text: str) -> str:
    return f"{name} must not be NaN at the prior mean with inputs of zero, but got {value_text}"


def _shape(result) -> tuple[int, ...] | None:
    """Shape of a result; None if it is not made of real numbers."""
    try:
        return as_floats(result).shape
    except ValueError:
        return None


def _said(shape: tuple[int, ...] | None, result) -> str:
    if shape is None or len(shape) > 2:
        return short_repr(result)
    if len(shape) == 1:
        return _count(shape[0], "entry").replace("entrys", "entries")
    return f"{shape[0]} x {shape[1]} numbers" if shape else f"the number {short_repr(result)}"


def _form(count: int) -> str:
    return f" (x is an array of {count} numbers)" if is_array(count) else ""


def _or_array(count: int) -> str:
    return " or array" if is_array(count) else ""


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


# A short hash that identifies a model: its quantities, and its functions' values at fixed points.


if TYPE_CHECKING:
    from thruster_env.model.state_space import StateSpaceModel

LENGTH = 12  # hexadecimal digits
MAGNITUDES = (0.0, 0.1, 1.0, 1.0, 10.0, 100.0)  # of states and inputs at the points
DIGITS = 10  # of a value: further ones differ from one machine to another
SMALL = 1e-2  # relative to the largest number at a point: smaller values may be differences, with fewer digits


def digest_of(model: StateSpaceModel) -> str:
    """A hash of names, units, sizes and substeps, and of the values of f and h at fixed points.

    The hash omits noise and prior, which tuning changes, Jacobians, which follow from the functions, and
    operating points and ranges, which only help a filter. The points are the same for all models of a size: points
    about the prior would change with it. Values are rounded to ten digits, so that other machines and versions of
    Python compute the same hash.
    """
    constants = getattr(model.constants, "_fields", len(model.constants))
    parts = {
        "quantities": model.quantities,
        "outputs": {symbol: output.quantity for symbol, output in model.outputs.items()},
        "sizes": (model.n, model.inputs, model.m, model.substeps),
        "constants": constants,
        "transition": _values(model.transition, model, (model.n, model.inputs)),
        "observe": _values(model.observe, model, (model.n,)),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:LENGTH]


def _points(sizes: tuple[int, ...]) -> list[list[tuple[float, ...]]]:
    """Vectors of the sizes for each point; every other point has positive components only."""
    points = []
    for k, magnitude in enumerate(MAGNITUDES):
        signs = (1.0, -1.0) if k % 2 else (1.0, 1.0)
        points.append(
            [
                tuple(magnitude * signs[(i + j) % 2] * (1.0 + ((3 * i + 5 * k + j) % 7) / 7) for i in range(size))
                for j, size in enumerate(sizes)
            ]
        )
    return points


def _values(function: Callable, model: StateSpaceModel, sizes: tuple[int, ...]) -> list:
    """The values of a function at the points, rounded, or the type of its exception."""
    results: list = []
    for point in _points(sizes):
        try:
            with np.errstate(all="ignore"):
                values = [float(value) for value in function(*map(as_value, point), model.given_constants)]
        except Exception as error:  # the model is not defined at this point, which identifies it, too
            results.append(type(error).__name__)
            continue
        numbers = [*values, *(x for vector in point for x in vector)]
        largest = max((abs(number) for number in numbers if math.isfinite(number)), default=0.0)
        results.append([_rounded(value, largest) for value in values])
    return results


def _rounded(value: float, largest: float) -> str:
    if not math.isfinite(value):
        return str(value)
    if abs(value) >= SMALL * largest > 0.0:
        return f"{value:.{DIGITS - 1}e}"
    return str(round(value / largest * 10**DIGITS / SMALL)) if largest > 0.0 else "0"
