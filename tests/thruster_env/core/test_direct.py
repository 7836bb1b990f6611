"""Calls without a look at the types of their arguments."""

import warnings

import numpy as np
import pytest

from thruster_env.core.compiled import CompiledOrPython, compiled, direct, interpreted


def scaled_sum(values, factor, twice):
    total = 0.0
    for value in values:
        total += factor * value * (2.0 if twice else 1.0)
    return total


def lengths(values):
    return {"length": len(values)}.popitem  # numba knows no bound methods of built-in types


VALUES = np.arange(4.0)


@pytest.mark.parametrize("wrap", [compiled, CompiledOrPython])
def test_the_machine_code_computes_what_the_compiled_function_does(wrap):
    function = wrap(scaled_sum)
    by_numba = function(VALUES, 3.0, True)
    quick = direct(function, VALUES, 1.0, False)
    assert not hasattr(quick, "overloads") and quick is not function
    assert quick(VALUES, 3.0, True) == by_numba == 36.0
    assert quick(2 * VALUES, 3.0, False) == 36.0  # another array of the same type


def test_arguments_of_other_types_have_machine_code_of_their_own():
    function = compiled(scaled_sum)
    function(VALUES, 3.0, True)
    assert direct(function, VALUES[::2], 3.0, True) is function  # not contiguous, and not compiled yet
    function(VALUES[::2], 3.0, True)
    assert direct(function, VALUES[::2], 3.0, True)(VALUES[::2], 3.0, True) == 12.0
    assert direct(function, VALUES, 3.0, True)(VALUES, 3.0, True) == 36.0


def test_what_is_not_compiled_is_returned_as_it_is():
    with interpreted():
        function = CompiledOrPython(scaled_sum)
        assert compiled(scaled_sum) is direct(scaled_sum, VALUES, 1.0, False) is scaled_sum
        assert direct(function, VALUES, 1.0, False)(VALUES, 1.0, False) == 6.0
    waiting = CompiledOrPython(scaled_sum)
    assert direct(waiting, VALUES, 1.0, False) is waiting
    refused = CompiledOrPython(lengths)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        refused(VALUES)
    assert direct(refused, VALUES) is refused
