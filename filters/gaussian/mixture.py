"""A mixture of Gaussians with weights w, each of whose parts is a row of numbers: sums over the parts.

mean = sum of w_k x_k,  P = sum of w_k (P_k + (x_k - mean)(x_k - mean)')
after a measurement:  w_k becomes w_k N(v_k; 0, S_k)/L,  L = sum of w_k N(v_k; 0, S_k)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.angles import places_of, whole_turns, wrapped
from thruster_env.core.compiled import inlined
from thruster_env.core.sources import Source, lower_pairs


class Parts(NamedTuple):
    """Where the parts of a mixture lie in a row."""

    first: int
    stride: int  # from one to the next
    number: int


@cache
def blender(
    parts: Parts, size: int, x: int, p: int, angles: tuple[bool, ...], *, between: bool = True, wraps: bool = True
) -> Callable:
    """Return `blend(row, weights, target)`: mean and covariance of a mixture, which lie from a place on.

    In each part x and P begin at such places; the weights begin at one in the row. Angles of parts are put on one
    branch (`thruster_env.core.angles`); if it `wraps`, those of the mean lie in (-pi, pi]. Without what lies
    `between` the parts the covariance is the sum of w_k P_k.
    """
    source = Source("blend", "row, weights, target", result=(size, size))
    mean, cov, d = source.local("m", size), source.local("c", size, size), source.local("d", size)
    each = f"for k in range({parts.number}):", f"part = {parts.first} + {parts.stride} * k"
    if not source.loops:
        source.line(
            " = ".join([*(mean[i] for i in range(size)), *(cov[i, j] for i, j in lower_pairs(size)), "0.0"])
        )
    has_weight = "if row[weights + k] != 0.0:"  # 0 times the square of a part far away may be NaN
    for _ in source.inside(each[0]):
        source.line(each[1])
        for _ in source.inside(has_weight):
            for i in source.range(size):
                source.line(f"{mean[i]} += row[weights + k] * row[part + {x + i}]")
    for _ in source.inside(each[0]):
        source.line(each[1])
        source.line("w = row[weights + k]")
        for _ in source.inside(has_weight):
            for i in source.range(size if between else 0):
                source.line(f"{d[i]} = row[part + {x + i}] - {mean[i]}")
            for i in source.range(size):
                for j in source.range(i + 1):
                    apart = f" + {d[i]} * {d[j]}" * between
                    source.line(f"{cov[i, j]} += w * (row[part + {p + i * size + j}]{apart})")
    for i in source.range(size):
        source.line(f"row[target + {i}] = {mean[i]}")
        for j in source.range(i + 1):
            source.line(f"row[target + {i * size + j + size}] = row[target + {j * size + i + size}] = {cov[i, j]}")
    blend = source.function()
    if not any(angles):
        return blend
    align, angle_places = part_aligner(parts, x, angles), places_of(angles)

    @inlined
    def blend_aligned(row, weights, target):
        align(row, weights)
        blend(row, weights, target)
        if wraps:
            for i in angle_places:
                row[target + i] = wrapped(row[target + i])

    return blend_aligned


@cache
def part_aligner(parts: Parts, x_place: int, angles: tuple[bool, ...]) -> Callable:
    """Return `align(row, weights)`: put angles of a vector x of all parts on one branch, that of their mean."""
    (_, stride, count), places = parts, places_of(angles, parts.first + x_place)

    @inlined
    def align(row, weights):
        for i in places:
            s = c = 0.0
            for k in range(count):
                s += row[weights + k] * np.sin(row[i + k * stride])
                c += row[weights + k] * np.cos(row[i + k * stride])
            middle = np.arctan2(s, c)
            for k in range(count):
                row[i + k * stride] -= whole_turns(row[i + k * stride] - middle)

    return align


@cache
def weigher(parts: Parts, level: int) -> Callable:
    """Return `weigh(row, weights)`: weights after a measurement, by log-likelihoods; the log of their sum.

    It is for weights that each update begins with, none of which is zero.
    """
    (_, stride, count), first = parts, parts.first + level

    @inlined
    def weigh(row, weights):
        top = -math.inf
        for k in range(count):
            top = max(top, row[first + k * stride])
        total = 0.0
        for k in range(count):
            row[weights + k] *= math.exp(row[first + k * stride] - top)
            total += row[weights + k]
        for k in range(count):
            row[weights + k] /= total
        return top + math.log(total) if total > 0.0 else -math.inf

    return weigh


@cache
def log_weigher(parts: Parts, level: int) -> Callable:
    """Return `weigh(row, logs, weights)`: the same of weights that are carried on, by their logarithms.

    These lie from `logs` on; a weight of zero, -inf there, stays zero. A weight that is too small for a float64
    keeps its logarithm, so that its part comes back as soon as measurements speak for it.
    """
    (_, stride, count), first = parts, parts.first + level

    @inlined
    def weigh(row, logs, weights):
        top = -math.inf
        for k in range(count):
            row[logs + k] += row[first + k * stride]
            top = max(top, row[logs + k])
        total = 0.0
        for k in range(count):
            row[weights + k] = math.exp(row[logs + k] - top)
            total += row[weights + k]
        log_total = top + math.log(total) if total > 0.0 else -math.inf
        for k in range(count):
            row[weights + k] /= total
            row[logs + k] -= log_total
        return log_total

    return weigh


@inlined
def logarithm(weight):
    """The logarithm of a weight, -inf of zero."""
    return math.log(weight) if weight > 0.0 else -math.inf


def parts_of(extras: np.ndarray, number: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means (number, n), covariances (number, n, n) and weights, or their logarithms, of a belief's parts."""
    parts, weights = np.split(extras, [-number])
    means, covs, _ = np.split(parts.reshape(number, -1), [n, n + n * n], axis=1)
    return means.copy(), covs.reshape(number, n, n).copy(), weights.copy()


@inlined
def nothing(memory, given, numbers):
    """What comes before the first of several functions."""
