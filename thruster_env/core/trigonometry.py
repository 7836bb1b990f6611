"""Sine and cosine in operators: vector code in loops, and the same source for floats, arrays and tensors."""

from __future__ import annotations

import math

import numpy as np

from thruster_env.core.compiled import inlined, overloaded, when_compiling

_PI, _PER_TURN = math.pi, 0.5 / math.pi


@inlined
def cosine_and_sine_of_turns(turns):
    """cos(2 pi turns) and sin(2 pi turns) for |turns| <= 1/2: Taylor series at half the angle, doubled."""
    a = _PI * turns
    q = a * a
    s = -1.0 / 121645100408832000.0
    s = s * q + 1.0 / 355687428096000.0
    s = s * q - 1.0 / 1307674368000.0
    s = s * q + 1.0 / 6227020800.0
    s = s * q - 1.0 / 39916800.0
    s = s * q + 1.0 / 362880.0
    s = s * q - 1.0 / 5040.0
    s = s * q + 1.0 / 120.0
    s = s * q - 1.0 / 6.0
    s = (s * q + 1.0) * a
    c = -1.0 / 6402373705728000.0
    c = c * q + 1.0 / 20922789888000.0
    c = c * q - 1.0 / 87178291200.0
    c = c * q + 1.0 / 479001600.0
    c = c * q - 1.0 / 3628800.0
    c = c * q + 1.0 / 40320.0
    c = c * q - 1.0 / 720.0
    c = c * q + 1.0 / 24.0
    c = c * q - 0.5
    c = c * q + 1.0
    return 1.0 - 2.0 * s * s, 2.0 * s * c


@overloaded
def nearest_whole(x):
    """The whole number nearest to x, of a float, an array or a tensor; one instruction in compiled code.

    Of a remainder torch knows the derivative, of a floor it does not.
    """
    above = x + 0.5
    return above - above % 1.0


@when_compiling
def _teach_nearest_whole():
    from numba.extending import overload

    @overload(nearest_whole, inline="always")
    def _of_float(x):
        return lambda x: np.floor(x + 0.5)


@inlined
def cosine_and_sine(angle):
    """The cosine and sine of any angle [rad], of a float, an array or a tensor.

    Errors are some 2e-16 up to a right angle, and at most 1e-14 up to two turns.
    """
    turns = _PER_TURN * angle
    return cosine_and_sine_of_turns(turns - nearest_whole(turns))
