"""Attacks on functions that factories write: equal ones are one, others are not, and each keeps its numbers.

Each takes a generator and how long it may take [s], and returns a line with what it counted.
"""

from __future__ import annotations

import time

import numpy as np

from tests.thruster_env.core.test_equal_functions import FACTORIES
from thruster_env.core.equal_functions import captured_numbers, differ_in_numbers_alone, first_equal, with_numbers

NOT_COPIED = "from_text", "with_large_array", "with_members_of_a_local_class", "with_cache", "with_matrix"
SAME_CODE = [one for one in FACTORIES if one.__name__ not in NOT_COPIED]


def closures(rng: np.random.Generator, seconds: float) -> str:
    """Random factories and values, from 1e-300 to 1e300 and both zeros: the first of equal ones is right."""
    end, count = time.monotonic() + seconds, 0
    while count == 0 or time.monotonic() < end:
        make = SAME_CODE[rng.integers(len(SAME_CODE))]
        values = _value(rng), _value(rng)
        one, again, other = make(values[0]), make(values[0]), make(values[1])
        given = f"{make.__name__} of {values}"
        assert first_equal(one) == first_equal(again), given
        same = np.float64(values[0]).tobytes() == np.float64(values[1]).tobytes()
        assert (first_equal(one) == first_equal(other)) == same, given
        for function in (one, other):
            assert _bits(first_equal(function)(2.0)) == _bits(function(2.0)), given
        assert differ_in_numbers_alone(one, other), given
        assert _bits(with_numbers(one, captured_numbers(other))(2.0)) == _bits(other(2.0)), given
        count += 1
    return f"factories: {count} pairs of functions withstood"


def _value(rng: np.random.Generator) -> float:
    if rng.random() < 0.3:
        return float(rng.choice([0.0, -0.0, 1.0, 1e-9, np.inf]))
    return float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-300, 300))


def _bits(value: float) -> bytes:
    return np.float64(value).tobytes()
