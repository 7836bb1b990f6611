"""A function that decides, of numbers that are not known yet: called once for each outcome of its decisions.

    if x[0] > 0.0:                    y = where(x[0] > 0.0, math.sqrt(x[0]), 0.0)
        y = math.sqrt(x[0])
    else:
        y = 0.0

A condition asks its graph, which answers yes at first. Then the function is called again with the last answer
turned round, and so on, and between the results there is a choice. A loop that decides how long it goes on has no
end here; it raises TypeError, as what has too many outcomes does. Where a function itself raises an exception, as
`assert` does, the result is NaN, as that of arithmetic is in machine code where Python raises.

Beside each number y of a graph stands y', worked out by the chain rule from those of its arguments. Numbers
that do not move have none, so that nothing is multiplied by zero, and what the derivative shares with the value
is there once:

    x' = 1:  (sin(x) * x)' = cos(x) * x + sin(x)     # sin(x) is the number of the value's own graph

Forwards, because a filter's parameters are few, and because Fisher's information asks how each innovation
changes along each of them, which the other direction does not find.

Where a number is finite, so is its slope. A root at zero has none, or an infinite one: it is 0 there, which lies
between those of both sides, and so the slope of sqrt(v v) v is 0 at v = 0, as that of |v| v is. What fades
faster than its argument grows, 1/(1 + exp(x)) where exp(x) is infinite, has the slope 0, and not 0 times infinity.
Choices say this, as their derivatives are choices again: the rule holds for slopes of slopes.
"""

from __future__ import annotations

import dis
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from thruster_env.graphs.folding import POSITIVE, worked_out
from thruster_env.graphs.graphs import CONDITIONS, Graph, Number, needed_by, where

MOST_OUTCOMES = 64  # calls of a function
MOST_DECISIONS = 64  # in one call


def on_every_side(function: Callable[[], np.ndarray], graph: Graph) -> np.ndarray:
    """What a function of no arguments makes of numbers of a graph, an array (...) of objects, on all its branches.

    Raises:
        TypeError: if it decides too often, or its results have different shapes.
    """
    calls, failure = 0, None

    def outcome(known: dict[int, bool]) -> np.ndarray | None:
        nonlocal calls, failure
        calls += 1
        if calls > MOST_OUTCOMES:
            raise TypeError(f"a function must have at most {MOST_OUTCOMES} outcomes of its decisions")
        asked: list[Number] = []
        answers = dict(known)

        def decide(number: Number) -> bool:
            if number.value is not None:
                return number.value != 0.0
            condition = number if number.is_condition else number != 0.0
            if condition.place not in answers:
                if len(answers) >= MOST_DECISIONS:
                    raise TypeError(f"a function must decide at most {MOST_DECISIONS} times")
                answers[condition.place] = True
                asked.append(condition)
            return answers[condition.place]

        graph.decide = decide
        found: np.ndarray | None = None
        try:
            found = function()
        except Exception as error:
            if not answers or not _is_raised_there(error):
                raise
            failure = error
        for k, condition in reversed([*enumerate(asked)]):
            before = {one.place: True for one in asked[:k]}
            other = outcome(known | before | {condition.place: False})
            if found is None or other is None:
                known_one = found if other is None else other
                if known_one is None:
                    continue
                found, other = (np.full_like(known_one, np.nan) if one is None else one for one in (found, other))
            if other.shape != found.shape:
                raise TypeError(f"branches must have results of one shape, but got {found.shape}, {other.shape}")
            pairs = zip(found.ravel(), other.ravel(), strict=True)
            chosen = [where(condition, a, b) for a, b in pairs]
            found = np.array([*chosen, None], dtype=object)[:-1].reshape(found.shape)
        return found

    before, graph.decide = graph.decide, None
    try:
        found = outcome({})
    finally:
        graph.decide = before
    if found is None:
        raise failure or TypeError("a function must have a result")
    return found


def _is_raised_there(error: Exception) -> bool:
    """Whether a statement of a traced function itself raised an exception, not something that it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None or trace.tb_frame.f_globals.get("__name__") != "builtins":  # that of copies
        return False
    return trace.tb_frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]


# Derivatives of graphs of Numbers, forwards: how results change as the numbers change that they are made of.


Slope = Number | None  # None of a number that does not move


def added(*slopes: Slope) -> Slope:
    """The sum of slopes."""
    moving = [slope for slope in slopes if slope is not None]
    return sum(moving[1:], moving[0]) if moving else None


def along(numbers: Sequence[Number], moves: Mapping[int, Slope]) -> list[Slope]:
    """Derivatives of numbers in the direction in which the numbers at some places of their graph move.

    Args:
        numbers: to be differentiated.
        moves: by the place of each number that moves, its change, or None; what such are made of does not matter.
    """
    slopes: dict[int, Slope] = dict(moves)
    for number in needed_by(numbers, moves):
        if number.place not in slopes:
            of = [slopes[one.place] for one in number.of]
            slopes[number.place] = _RULES[number.operation](number, *number.of, *of) if any_of(of) else None
    return [slopes[number.place] for number in numbers]


def any_of(slopes: Sequence[Slope]) -> bool:
    """Whether there is a slope among some."""
    return any(slope is not None for slope in slopes)


def times(slope: Slope, factor: Callable[[], Number | float]) -> Slope:
    """A slope times a factor, which is worked out only if there is a slope."""
    return None if slope is None else slope * factor()


def _of_choice(y, condition, a, b, of_condition, da, db):
    return where(condition, 0.0 if da is None else da, 0.0 if db is None else db)


def _unless_zero(x, slope: Slope) -> Slope:
    """A slope, or 0 where x is zero."""
    return slope if slope is None or x.value or x.sign == POSITIVE else where(x == 0.0, 0.0, slope)


def _fading(slope: Slope, x: Number, factor: Callable[[], Number]) -> Slope:
    """The slope of a function of x times its derivative, which vanishes where x becomes infinite."""
    found = times(slope, factor)
    return _unless_zero(factor(), found) if found is not None and x.may_overflow else found


def _of_quotient(y, a, b, da, db):
    return added(times(da, lambda: 1.0 / b), _fading(db, b, lambda: -y / b))


def _of_power(y, x, e, dx, de):
    by_base = times(dx, lambda: e * x ** (e - 1.0))
    if e.value is None:
        by_base = None if by_base is None else where((x == 0.0) & (e < 1.0), 0.0, by_base)
    elif e.value < 1.0:
        by_base = _unless_zero(x, by_base)
    return added(by_base, _unless_zero(x, times(de, lambda: y * abs(x).log())))


def _of_angle(y, a, b, da, db):
    square = a * a + b * b
    slope = added(times(da, lambda: b / square), times(db, lambda: -a / square))
    return _unless_zero(square, slope)


def _of_length(y, a, b, da, db):
    """Half the slope of the square over the length; 0 at zero, as in between."""
    products = times(da, lambda: a), times(db, lambda: b)
    of_square = added(*map(_twice, products))
    return None if of_square is None else _unless_zero(y, 0.5 * of_square / y)


def _twice(slope: Slope) -> Slope:
    return None if slope is None else slope + slope


def _bell(x: Number) -> Number:
    """The derivative of the error function."""
    return (2.0 / math.sqrt(math.pi)) * (-x * x).exp()


def _none(y, *others):
    """Of what is constant but for jumps."""
    return None


_RULES: dict[str, Callable] = {
    "+": lambda y, a, b, da, db: added(da, db),
    "-": lambda y, a, b, da, db: added(da, None if db is None else -db),
    "*": lambda y, a, b, da, db: added(times(da, lambda: b), times(db, lambda: a)),
    "/": _of_quotient,
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
    "pow": _of_power,
    "arctan2": _of_angle,
    "where": _of_choice,
    "hypot": _of_length,
    "fmod": lambda y, a, b, da, db: added(da, times(db, lambda: (y - a) / b)),
    "copysign": lambda y, a, b, da, db: times(da, lambda: where(a < 0.0, -1.0, 1.0) * where(y < 0.0, -1.0, 1.0)),
    **dict.fromkeys((*CONDITIONS, "floor", "ceil", "rint"), _none),
}
