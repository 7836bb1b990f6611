"""Derivatives of graphs of Numbers, forwards: how results change as the numbers change that they are made of.

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

import math
from collections.abc import Callable, Mapping, Sequence

from thruster_env.graphs.folding import worked_out
from thruster_env.graphs.graphs import CONDITIONS, Number, needed_by, where
from thruster_env.graphs.magnitudes import POSITIVE

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
