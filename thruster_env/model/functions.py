"""Checks of the functions of a model: shapes, numbers, and Jacobians against the functions' own slopes."""

from __future__ import annotations

import inspect
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FunctionType

import numpy as np

from thruster_env.core.angles import difference
from thruster_env.core.checks import as_floats, short_repr
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.modules import error_line
from thruster_env.core.sources import as_value, is_array
from thruster_env.graphs.python_floats import with_floats
from thruster_env.model.turns import refuse_signs

_compared: weakref.WeakKeyDictionary[CodeType, weakref.WeakSet] = weakref.WeakKeyDictionary()  # f with Jacobians


def check_functions(model) -> None:
    """Raise ValueError unless a model's f and h, and their Jacobians if given, have the shapes of its numbers."""
    n, m, arguments_of_h = model.n, model.channels, "x, u, c" if model.feeds else "x, c"
    states, measured = _count(n, "state"), _count(m, "measurement")
    by_states, by_noise = f"as prior_mean has {n}", f"as measurement_noise_cov is {model.m} x {model.m}"
    by_noise += " and a rotation, direction or pose has one more" * bool(model.measured_turns)
    rules = {
        "transition": ("x, u, c", (n,), f"a tuple{_or_array(n)} of {states}, {by_states}"),
        "observe": (arguments_of_h, (m,), f"a tuple{_or_array(m)} of {measured}, {by_noise}"),
        "transition_jacobian": ("x, u, c", (n, n), f"{_count(n, 'row')} of {n}, {by_states}"),
        "observe_jacobian": (arguments_of_h, (m, n), f"{_count(m, 'row')} of {n}, {by_noise}"),
    }
    for name, (arguments, shape, rule) in rules.items():
        function = getattr(model, name)
        if function is not None:
            _check_arguments(name, function, arguments)
            _check_result(name, function, model, arguments, shape, rule)
    if model.turns:
        refuse_signs(lambda x: model.observe(*_arguments(arguments_of_h, model, x)), model)
    if not (model.turns or model.measured_turns or is_array(n)):
        for name in ("transition", "observe"):
            sentence = wrong_slope(model, name, rules[name][0])
            if sentence:
                warnings.warn(sentence, stacklevel=5)


def check_values(model) -> None:
    """Raise ValueError as `check_functions` does, in a tenth of the time, for functions that passed it before.

    Only numbers differ: constants or the prior mean. Each function is called once there.
    """
    arguments = {"transition": "x, u, c", "observe": "x, u, c" if model.feeds else "x, c"}
    by_users = (name for name in arguments if not by_complex_step(getattr(model, f"{name}_jacobian")))
    finite = True
    try:
        with np.errstate(all="ignore"):
            for name in (*arguments, *(f"{name}_jacobian" for name in by_users)):
                function, names = getattr(model, name), arguments[name.removesuffix("_jacobian")]
                values = () if function is None else function(*_arguments(names, model, model.prior_mean))
                finite = finite and bool(np.isfinite(as_floats(values)).all())
    except Exception:
        finite = False
    if not finite:  # infinity may be right: the whole check decides, and names the reason
        check_functions(model)


def wrong_slope(model, name: str, arguments: str) -> str:
    """A sentence on the entry of a user's Jacobian that is furthest from the function's slope, once, if one is.

    The slope is a difference at a point near the prior mean, with inputs of zero. An entry counts if it is off by
    more than a tenth, if that is more than a thousandth of what its row changes by when each state does by its
    scale, and if differences of other lengths, above and below, are the same: elsewhere the function has a kink.
    Of functions that differ in their closures alone, as in a search for parameters, the first ones are compared.
    """
    function, jacobian = getattr(model, name), getattr(model, f"{name}_jacobian")
    if jacobian is None or by_complex_step(jacobian):
        return ""
    if isinstance(function, FunctionType) and isinstance(jacobian, FunctionType):
        compared = _compared.setdefault(function.__code__, weakref.WeakSet())
        if jacobian.__code__ in compared:
            return ""
        compared.add(jacobian.__code__)
    mean, scales = model.prior_mean, model.scales
    reach = np.minimum(scales, np.maximum(1.0, abs(mean)))
    x = mean + reach * (0.5 + 0.25 * np.cos(np.arange(model.n)))
    angles = model.any_shape.state_angles if name == "transition" else model.any_shape.measurement_angles

    def value(function: Callable, x: np.ndarray) -> np.ndarray:
        return as_floats(function(*_arguments(arguments, model, x)))

    def slopes(h: np.ndarray) -> np.ndarray:
        ends = [value(function, x + step) for step in np.diag(h)]
        return np.transpose([difference(end, middle, angles) for end in ends]) / h

    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            middle, stated = value(function, x), value(jacobian, x)
            differences = [slopes(factor * reach) for factor in (1e-4, -1e-4, 1e-5, -1e-5)]
    except Exception:  # no value there
        return ""
    slope, spread = np.mean(differences, axis=0), np.ptp(differences, axis=0)
    change = (np.maximum(abs(slope), abs(stated)) * scales).max(axis=1, keepdims=True)
    off, largest = abs(stated - slope), np.maximum(abs(stated), abs(slope))
    wrong = (off > 0.1 * largest) & (off * scales > 1e-3 * change) & (off > 10.0 * spread)
    if not wrong.any():
        return ""
    i, j = np.unravel_index(np.argmax(wrong * off * scales / np.where(change > 0.0, change, 1.0)), off.shape)
    return (
        f"{name}_jacobian must be the slope of {name}, but entry [{i}][{j}] is {stated[i, j]:.4g} at x = "
        f"{short_repr(x.tolist())}, where the slope is {slope[i, j]:.4g}: leave it out, and it follows from {name}"
    )


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
    if not _takes(signature, arguments):
        known = "(x, c) or (x, u, c)" if name == "observe" else f"({arguments})"
        raise ValueError(f"{name} must be a function of {known}, but takes {signature}")


def takes_input(observe: Callable) -> bool:
    """Whether h is one of (x, u, c) and not of (x, c)."""
    try:
        signature = inspect.signature(observe)
    except (TypeError, ValueError):  # what is written in C
        return False
    return _takes(signature, "x, u, c") and not _takes(signature, "x, c")


def _takes(signature: inspect.Signature, arguments: str) -> bool:
    try:
        signature.bind(*arguments.split(", "))
    except TypeError:
        return False
    return True


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
            more = ": inputs=, or input_quantities=, says how many there are" * isinstance(error, IndexError)
            text = f"{name}{where} must work for {sizes}, but raised {error_line(error)}{more}"
            raise ValueError(text) from error
        result_shape = _shape(result)
        if result_shape != shape:
            raise ValueError(f"{name} must return {rule}, but returned {_said(result_shape, result)}")
        if not slopes and (kind := _rounding(result)):
            raise ValueError(
                f"{name}{_place(function)} must return numbers of float64, but returned {kind}, to which they are "
                "rounded: make its arrays with dtype=float"
            )
        if must_be_known and np.isnan(as_floats(result)).any():
            raise ValueError(_not_nan(name, short_repr(result)))
        if at_mean and slopes and not by_complex_step(function) and not np.isfinite(as_floats(result)).all():
            _refuse_slopes(name, model, arguments, short_repr(result))
        again = function(*_arguments(arguments, model, point))
        if not np.array_equal(as_floats(again), as_floats(result), equal_nan=True):
            where, noise = _place(function), "process" if name.startswith("transition") else "measurement"
            raise ValueError(
                f"{name}{where} must depend on its arguments alone, but two calls gave {short_repr(result)} and "
                f"{short_repr(again)}: noise belongs in {noise}_noise_cov"
            )
        return


def _not_nan(name: str, value_text: str) -> str:
    return f"{name} must not be NaN at the prior mean with inputs of zero, but got {value_text}"


def _shape(result) -> tuple[int, ...] | None:
    """Shape of a result; None if it is not made of real numbers."""
    try:
        return as_floats(result).shape
    except ValueError:
        return None


def _rounding(result) -> str:
    """The type of an array of whole numbers, or of any numbers shorter than float64; empty for others."""
    if isinstance(result, np.ndarray) and result.dtype.kind in "iub":
        return f"an array of {result.dtype}"
    parts = (result,) if isinstance(result, np.ndarray) else result
    kinds = [part.dtype for part in parts if isinstance(part, np.ndarray | np.floating)]
    return next((str(kind) for kind in kinds if kind.kind == "f" and kind.itemsize < 8), "")


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
