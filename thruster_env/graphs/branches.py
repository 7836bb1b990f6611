"""Functions with branches on unknown numbers: called once for each outcome of their decisions, with derivatives.

    if x[0] > 0.0:                    y = where(x[0] > 0.0, math.sqrt(x[0]), 0.0)
        y = math.sqrt(x[0])
    else:
        y = 0.0

At a condition the graph first answers yes. Then the function is called again with the last answer inverted, and
so on, and a `where` joins the results. A loop whose length depends on an unknown number never ends that way; it
raises TypeError, as does a function with too many outcomes. If the function itself raises an exception, as
`assert` does, the result is NaN, as in machine code for arithmetic at which Python raises.

Functions that a function calls are joined each by itself (`tracing`), so that their outcomes add up: three calls
of a function with four outcomes have twelve, and not 64.

Each number y of a graph has a slope y', by the chain rule from the slopes of its arguments. Numbers that do not
move have none, so nothing is multiplied by zero. Terms that the derivative shares with the value exist once:

    x' = 1:  (sin(x) * x)' = cos(x) * x + sin(x)     # sin(x) is the number of the value's own graph

This is forward mode, because a filter's parameters are few, and because Fisher's information needs the slope of
each innovation along each of them, which reverse mode does not give.

If a number is finite, so is its slope. A root has the slope 0 at zero, between the slopes of both sides, so the
slope of sqrt(v v) v is 0 at v = 0, like that of |v| v. A function that fades faster than its argument grows, such
as 1/(1 + exp(x)) where exp(x) is infinite, has the slope 0, and not 0 times infinity. These rules are `where`s,
whose derivatives are `where`s again, so they hold for slopes of slopes, too.
"""

from __future__ import annotations

import copy
import dis
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from thruster_env.graphs.folding import POSITIVE, worked_out
from thruster_env.graphs.graphs import CONDITIONS, Graph, Number, needed_by, where

MOST_OUTCOMES = 64  # calls of a function
MOST_DECISIONS = 64  # in one call
MOST_IN_ALL = 4096  # calls of a function and of all that it calls
NUMBERS = Number, int, float, np.generic


RAISED = object()  # in place of a result, where the function itself raised an exception


def on_every_side(function: Callable[[], Any], graph: Graph) -> Any:
    """The result of a function without arguments, of numbers of a graph, joined over all its branches.

    The result may be a number, an array, a collection or an object of these.

    Raises:
        TypeError: if it decides too often, or its results have different shapes.
    """
    calls, failure = 0, None
    outside, outer = graph.decide, graph.answers
    graph.outcomes = 0 if outside is None else graph.outcomes

    def outcome(known: dict[int, bool]) -> Any:
        nonlocal calls, failure
        calls += 1
        graph.outcomes += calls > 1
        if calls > MOST_OUTCOMES or graph.outcomes > MOST_IN_ALL:
            raise TypeError(f"a function must have at most {MOST_OUTCOMES} outcomes of its decisions")
        asked: list[Number] = []
        answers = outer | known

        def decide(number: Number) -> bool:
            if number.value is not None:
                return number.value != 0.0
            condition = number if number.is_condition else number != 0.0
            if condition.place not in answers:
                if len(answers) - len(outer) >= MOST_DECISIONS:
                    raise TypeError(f"a function must decide at most {MOST_DECISIONS} times")
                answers[condition.place] = True
                asked.append(condition)
            return answers[condition.place]

        graph.decide, graph.answers = decide, answers
        try:
            result = function()
        except Exception as error:
            if len(answers) == len(outer) or not _is_raised_there(error):
                raise
            if not graph.may_raise:
                raise TypeError(f"it must not raise exceptions, but raises {error!r}") from error
            result, failure = RAISED, error
        for k, condition in reversed([*enumerate(asked)]):
            before = {earlier.place: True for earlier in asked[:k]}
            result = joined(condition, result, outcome(known | before | {condition.place: False}))
        return result

    try:
        result = outcome({})
    finally:
        graph.decide, graph.answers = outside, outer
    if result is RAISED:
        raise failure or TypeError("a function must have a result")
    return result


def joined(condition: Number, a: Any, b: Any) -> Any:
    """The result `a` where a condition holds, else `b`: numbers, or arrays, collections and objects of these.

    Where a side is RAISED, all numbers are NaN. Raises TypeError unless both are of one shape.
    """
    if a is b:
        return a
    if a is RAISED or b is RAISED:
        a, b = (_lost(b), b) if a is RAISED else (a, _lost(a))
    if isinstance(a, NUMBERS) and isinstance(b, NUMBERS):
        return where(condition, a, b)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and a.shape == b.shape:
        return _of_entries([joined(condition, *pair) for pair in zip(a.flat, b.flat, strict=True)], a)
    if type(a) is type(b):
        if isinstance(a, tuple | list) and len(a) == len(b):
            return _of_entries([joined(condition, *pair) for pair in zip(a, b, strict=True)], a)
        if isinstance(a, dict) and a.keys() == b.keys():
            return {key: joined(condition, part, b[key]) for key, part in a.items()}
        if isinstance(a, str) and a == b:
            return a
        if hasattr(a, "__dict__"):
            return _with_attributes(a, joined(condition, vars(a), vars(b)))
    shapes = (np.shape(side) if isinstance(side, np.ndarray | tuple | list) else type(side) for side in (a, b))
    raise TypeError("branches must have results of one shape, but got {}, {}".format(*shapes))


def _lost(value: Any) -> Any:
    """A value of the same shape with NaN in place of numbers."""
    if isinstance(value, NUMBERS):
        return math.nan
    if isinstance(value, np.ndarray | tuple | list):
        return _of_entries(
            [_lost(part) for part in (value.flat if isinstance(value, np.ndarray) else value)], value
        )
    if isinstance(value, dict):
        return {key: _lost(part) for key, part in value.items()}
    return _with_attributes(value, _lost(vars(value))) if hasattr(value, "__dict__") else value


def _of_entries(entries: list, like: Any) -> Any:
    """Entries as an array, tuple or list like another one."""
    if isinstance(like, np.ndarray):
        return np.array([*entries, None], dtype=object)[:-1].reshape(like.shape)
    return type(like)(*entries) if hasattr(like, "_fields") else type(like)(entries)


def _with_attributes(value: Any, attributes: dict) -> Any:
    other = copy.copy(value)
    other.__dict__.update(attributes)
    return other


def _is_raised_there(error: Exception) -> bool:
    """Whether a statement of a traced function itself raised an exception, not something that it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None or trace.tb_frame.f_globals.get("__name__") != "builtins":  # that of copies
        return False
    return trace.tb_frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]


Slope = Number | None  # None of a number that does not move


def added(*slopes: Slope) -> Slope:
    """The sum of slopes."""
    moving = [slope for slope in slopes if slope is not None]
    return sum(moving[1:], moving[0]) if moving else None


def along(numbers: Sequence[Number], moves: Mapping[int, Slope]) -> list[Slope]:
    """Directional derivatives of numbers, given the slopes of some numbers of their graph.

    Args:
        numbers: to be differentiated.
        moves: the slope of each number that moves, or None, by its place; its arguments are not differentiated.
    """
    slopes: dict[int, Slope] = dict(moves)
    for number in needed_by(numbers, moves):
        if number.place not in slopes:
            of = [slopes[argument.place] for argument in number.of]
            moving = any(slope is not None for slope in of)
            slopes[number.place] = _RULES[number.operation](number, *number.of, *of) if moving else None
    return [slopes[number.place] for number in numbers]


def times(slope: Slope, factor: Callable[[], Number | float]) -> Slope:
    """A slope times a factor, which is evaluated only if there is a slope."""
    return None if slope is None else slope * factor()


def _unless_zero(x, slope: Slope) -> Slope:
    """A slope, or 0 where x is zero."""
    return slope if slope is None or x.value or x.sign == POSITIVE else where(x == 0.0, 0.0, slope)


def _fading(slope: Slope, x: Number, factor: Callable[[], Number]) -> Slope:
    """The slope of a function of x times its derivative, which vanishes where x becomes infinite."""
    product = times(slope, factor)
    return _unless_zero(factor(), product) if product is not None and x.may_overflow else product


def _power_slope(y, x, e, dx, de):
    by_base = times(dx, lambda: e * x ** (e - 1.0))
    if e.value is None:
        by_base = None if by_base is None else where((x == 0.0) & (e < 1.0), 0.0, by_base)
    elif e.value < 1.0:
        by_base = _unless_zero(x, by_base)
    return added(by_base, _unless_zero(x, times(de, lambda: y * abs(x).log())))


def _angle_slope(y, a, b, da, db):
    square = a * a + b * b
    slope = added(times(da, lambda: b / square), times(db, lambda: -a / square))
    return _unless_zero(square, slope)


def _length_slope(y, a, b, da, db):
    """Half the slope of the square over the length; 0 at zero, as in between."""
    products = times(da, lambda: a), times(db, lambda: b)
    of_square = added(*(None if slope is None else slope + slope for slope in products))
    return None if of_square is None else _unless_zero(y, 0.5 * of_square / y)


def _bell(x: Number) -> Number:
    return (2.0 / math.sqrt(math.pi)) * (-x * x).exp()


_RULES: dict[str, Callable] = {
    "+": lambda y, a, b, da, db: added(da, db),
    "-": lambda y, a, b, da, db: added(da, None if db is None else -db),
    "*": lambda y, a, b, da, db: added(times(da, lambda: b), times(db, lambda: a)),
    "/": lambda y, a, b, da, db: added(times(da, lambda: 1.0 / b), _fading(db, b, lambda: -y / b)),
    "negative": lambda y, x, dx: -dx,
    "abs": lambda y, x, dx: where(x < 0.0, -dx, dx),
    "sqrt": lambda y, x, dx: _unless_zero(y, 0.5 * dx / y),
    "exp": lambda y, x, dx: _fading(dx, x, lambda: y),
    "log": lambda y, x, dx: dx / x,
    "sin": lambda y, x, dx: dx * x.cos(),
    "cos": lambda y, x, dx: -dx * x.sin(),
    "tan": lambda y, x, dx: dx * (1.0 + y * y),
    "arctan": lambda y, x, dx: _fading(dx, x, lambda: 1.0 / (1.0 + x * x)),
    "tanh": lambda y, x, dx: _fading(dx, x, lambda: 1.0 - y * y),
    "sinh": lambda y, x, dx: dx * x.cosh(),
    "cosh": lambda y, x, dx: dx * x.sinh(),
    "cbrt": lambda y, x, dx: _unless_zero(y, dx / (3.0 * y * y)),
    "exp2": lambda y, x, dx: _fading(dx, x, lambda: math.log(2.0) * y),
    "expm1": lambda y, x, dx: _fading(dx, x, lambda: y + 1.0),
    "log1p": lambda y, x, dx: dx / (1.0 + x),
    "log2": lambda y, x, dx: dx / (math.log(2.0) * x),
    "log10": lambda y, x, dx: dx / (math.log(10.0) * x),
    "arcsinh": lambda y, x, dx: dx / worked_out("hypot", x, x.graph.constant(1.0)),
    "arccosh": lambda y, x, dx: _unless_zero(y, dx / ((x - 1.0).sqrt() * (x + 1.0).sqrt())),
    "arctanh": lambda y, x, dx: dx / ((1.0 - x) * (1.0 + x)),
    "erf": lambda y, x, dx: _fading(dx, x, lambda: _bell(x)),
    "erfc": lambda y, x, dx: _fading(dx, x, lambda: -_bell(x)),
    "pow": _power_slope,
    "arctan2": _angle_slope,
    "where": lambda y, condition, a, b, _, da, db: where(
        condition, 0.0 if da is None else da, 0.0 if db is None else db
    ),
    "hypot": _length_slope,
    "fmod": lambda y, a, b, da, db: added(da, times(db, lambda: (y - a) / b)),
    "copysign": lambda y, a, b, da, db: times(da, lambda: where(a < 0.0, -1.0, 1.0) * where(y < 0.0, -1.0, 1.0)),
    **dict.fromkeys((*CONDITIONS, "floor", "ceil", "rint"), lambda *_: None),  # constant except for jumps
}
