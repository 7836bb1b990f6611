"""Attacks on derivatives: at kinks and zeros, and far from the origin."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import numpy as np

from tests.fuzz.python_interface import _line, _until
from tests.thruster_env.graphs.test_traced_arithmetic import slopes_of
from thruster_env.graphs.programs import values_of

INNER = (  # of which all are zero or have a kink at the origin
    lambda x, y: x,
    lambda x, y: y * abs(y),
    lambda x, y: math.sqrt(x * x + y * y),
    lambda x, y: (x * x + y * y) ** 0.5,
    lambda x, y: math.sqrt(abs(x)),
    lambda x, y: math.sqrt(max(x, 0.0)),
    lambda x, y: abs(y) ** 1.5,
    lambda x, y: abs(x) ** 0.3,
    lambda x, y: abs(x) ** (y + 1.2),
    lambda x, y: math.atan2(y, x),
    lambda x, y: np.hypot(x, 0.1 * y),
    lambda x, y: np.where(x > 0.0, math.sqrt(abs(x)), -y),
)
OUTER = (
    lambda a, b: a * b,
    lambda a, b: a + b,
    lambda a, b: a / (1.0 + abs(b)),
    lambda a, b: a * math.sqrt(abs(b)),
    lambda a, b: math.tanh(a - b),
    lambda a, b: 1.0 / (1.0 + math.exp(800.0 - 10.0 * (a - b))),
    lambda a, b: math.sqrt(a * a + b * b),
    lambda a, b: max(a, b),
    lambda a, b: math.atan2(a, b),
    lambda a, b: abs(a) ** (1.0 + abs(b)),
)


def kinks_and_zeros(rng: np.random.Generator, seconds: float) -> str:
    """Functions of roots, powers and angles, nested: finite slopes at zero, those of differences beside it."""
    counts = Counter()
    for _ in _until(seconds):
        function = nested(OUTER[rng.integers(len(OUTER))], *(INNER[k] for k in rng.integers(len(INNER), size=2)))
        numbers = slopes_of(function)
        zeros, beside = np.zeros((2, 3)), rng.uniform(0.1, 0.9, size=(2, 3)) * rng.choice([-1.0, 1.0], size=(2, 3))
        zeros[0, 1], zeros[1, 2] = rng.uniform(-1.0, 1.0, size=2)
        with np.errstate(all="ignore"):
            at_zero, found = values_of(numbers, zeros), values_of(numbers, beside)
        known = np.isfinite(at_zero[0])
        assert np.isfinite(at_zero[:, known]).all(), (zeros, at_zero)
        for k, point in enumerate(beside.T):
            for axis in range(2):
                sides = [found_at(function, point + h * np.eye(2)[axis]) for h in (2e-6, 1e-6, -1e-6, -2e-6)]
                slopes = [(sides[1] - sides[2]) / 2e-6, (sides[0] - sides[3]) / 4e-6]
                if math.isclose(*slopes, rel_tol=1e-4, abs_tol=1e-6):  # no kink between
                    close = math.isclose(found[1 + axis, k], slopes[0], rel_tol=1e-3, abs_tol=1e-5)
                    assert close, (point, axis, found[1 + axis, k], slopes)
        counts["functions"] += 1
    return _line("kinks and zeros", counts)


def nested(outer: Callable, f: Callable, g: Callable) -> Callable:
    """A function of two functions."""
    return lambda x, y: outer(f(x, y), g(x, y))


def found_at(function: Callable, point: np.ndarray) -> float:
    """The value of a function as Python has it."""
    try:
        return float(function(*point.tolist()))
    except ArithmeticError:
        return math.nan
