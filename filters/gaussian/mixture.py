"""A mixture in a row of numbers, its parts one behind the other at equal distances: entries, mean, covariance."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from numerics.angles import NAMES, places_of
from numerics.compiled import inlined
from numerics.sources import Source, lower_pairs, tuple_of, written_out
from plants.shape import constants_are_array


@cache
def part_vector(count: int, first: int, stride: int) -> tuple[Callable, Callable]:
    """Functions `read(row, j)` and `store(row, j, x)`: the entries of part j from row[first + stride j] on."""
    read, store = Source("read", "row, j", result=(count,)), Source("store", "row, j, x", x=(count,))
    for source in (read, store):
        source.line(f"k = {first} + {stride} * j")
    for i in store.range(count):
        store.line(f"row[k + {i}] = x[{i}]")
    return read.function(read.vector(count, lambda i: f"row[k + {i}]")), store.function()


@cache
def part_constants(count: int, first: int, stride: int) -> Callable:
    """Return `read(row, j)`: the constants of an affine model, a part of a filter's numbers."""
    if constants_are_array(count):
        place = f"{first} + {stride} * j"
        return written_out("read", "row, j", f"row[{place} : {place} + {count}]")
    entries = tuple_of(f"row[k + {i}]" for i in range(count))
    return written_out("read", "row, j", f"k = {first} + {stride} * j", entries)


@cache
def part_matrix(size: int, first: int, stride: int) -> tuple[Callable, Callable]:
    """Functions `read(row, j)` and `store(row, j, a)`: a square matrix of part j, by rows."""
    shape = size, size
    read, store = Source("read", "row, j", result=shape), Source("store", "row, j, a", a=shape)
    for source in (read, store):
        source.line(f"k = {first} + {stride} * j")
    for i in store.range(size):
        for j in store.range(size):
            store.line(f"row[k + {i * size + j}] = a[{i}][{j}]")
    return read.function(read.matrix(size, size, lambda i, j: f"row[k + {i * size + j}]")), store.function()


@cache
def _mean_blender(count: int, means: int, weights: int, stride: int) -> Callable:
    """Return `mean_of(row, parts)`."""
    source = Source("mean_of", "row, parts", result=(count,))
    total = source.local("s", count)
    if not source.loops:
        for i in range(count):
            source.line(f"{total[i]} = 0.0")
    for _ in source.inside("for part in range(parts):"):
        source.line(f"k = {stride} * part")
        source.line(f"w = row[k + {weights}]")
        for i in source.range(count):
            source.line(f"{total[i]} += w * row[k + {means + i}]")
    return source.function(source.whole(total))


@cache
def blender(
    count: int,
    means: int,
    covs: int,
    weights: int,
    stride: int,
    angles: tuple[bool, ...] = (),
    between: bool = True,
) -> Callable:
    """Return `blend(row, parts)`: mean and covariance of a mixture from those of its parts and their weights.

    The covariance is that within the parts and that between them: sum of w (P + (x - mean)(x - mean)'), or that
    within them alone, sum of w P. The means, covariances and weights of the first part lie from row[means],
    row[covs] and row[weights] on. Means of parts that are angles are put on one branch (`numerics.angles`).
    """
    mean_of = _mean_blender(count, means, weights, stride)
    source = Source("cov_of", "row, parts, mean", result=(count, count), mean=(count,))
    total, d = source.local("s", count, count), source.local("d", count)
    if not source.loops:
        for i, j in lower_pairs(count):
            source.line(f"{total[i, j]} = 0.0")
    for _ in source.inside("for part in range(parts):"):
        source.line(f"k = {stride} * part")
        source.line(f"w = row[k + {weights}]")
        if between:
            for i in source.range(count):
                source.line(f"{d[i]} = row[k + {means + i}] - mean[{i}]")
        for i in source.range(count):
            for j in source.range(i + 1):
                apart = f" + {d[i]} * {d[j]}" if between else ""
                source.line(f"{total[i, j]} += w * (row[k + {covs + i * count + j}]{apart})")
    cov_of = source.function(source.mirrored(total))

    @inlined
    def blend(row, parts):
        mean = mean_of(row, parts)
        return mean, cov_of(row, parts, mean)

    if not any(angles):
        return blend
    align = part_aligner(means, weights, stride, angles)

    @inlined
    def blend_aligned(row, parts):
        align(row, parts)
        return blend(row, parts)

    return blend_aligned


@cache
def part_aligner(means: int, weights: int, stride: int, angles: tuple[bool, ...]) -> Callable:
    """Return `align(row, parts)`: put means of parts that are angles on the branch of their circular mean."""
    lines = (
        f"for place in {places_of(angles, means)}:",
        "    s = c = 0.0",
        "    for part in range(parts):",
        f"        k = {stride} * part",
        f"        s += row[k + {weights}] * sin(row[k + place])",
        f"        c += row[k + {weights}] * cos(row[k + place])",
        "    middle = arctan2(s, c)",
        "    for part in range(parts):",
        f"        k = {stride} * part + place",
        "        row[k] -= whole_turns(row[k] - middle)",
    )
    return written_out("align", "row, parts", *lines, "None", **NAMES)
