"""A mixture in a row of numbers, its parts one behind the other at equal distances: entries, mean, covariance."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from numerics.angles import NAMES
from numerics.compiled import inlined
from numerics.tuples import matrix_of, tuple_of, written_out


@cache
def part_vector(count: int, first: int, stride: int) -> tuple[Callable, Callable]:
    """Functions `read(row, j)` and `store(row, j, x)`: the entries of part j from row[first + stride j] on."""
    place = f"k = {first} + {stride} * j"
    read = written_out("read", "row, j", place, tuple_of(f"row[k + {i}]" for i in range(count)))
    stores = (f"row[k + {i}] = x[{i}]" for i in range(count))
    return read, written_out("store", "row, j, x", place, *stores, "None")


@cache
def part_matrix(size: int, first: int, stride: int) -> tuple[Callable, Callable]:
    """Functions `read(row, j)` and `store(row, j, a)`: a square matrix of part j, by rows."""
    place = f"k = {first} + {stride} * j"
    places = [(i, j) for i in range(size) for j in range(size)]
    read = written_out("read", "row, j", place, matrix_of(size, size, lambda i, j: f"row[k + {i * size + j}]"))
    stores = (f"row[k + {i * size + j}] = a[{i}][{j}]" for i, j in places)
    return read, written_out("store", "row, j, a", place, *stores, "None")


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
    pairs = [(i, j) for i in range(count) for j in range(i + 1)]
    spread = " + d{} * d{}" if between else ""
    mean_of = written_out(
        "mean_of",
        "row, parts",
        *(f"s{i} = 0.0" for i in range(count)),
        "for part in range(parts):",
        f"    k = {stride} * part",
        f"    w = row[k + {weights}]",
        *(f"    s{i} += w * row[k + {means + i}]" for i in range(count)),
        tuple_of(f"s{i}" for i in range(count)),
    )
    cov_of = written_out(
        "cov_of",
        "row, parts, mean",
        *(f"s{i}_{j} = 0.0" for i, j in pairs),
        "for part in range(parts):",
        f"    k = {stride} * part",
        f"    w = row[k + {weights}]",
        *(f"    d{i} = row[k + {means + i}] - mean[{i}]" for i in range(count) if between),
        *(f"    s{i}_{j} += w * (row[k + {covs + i * count + j}]{spread.format(i, j)})" for i, j in pairs),
        matrix_of(count, count, lambda i, j: f"s{max(i, j)}_{min(i, j)}"),
    )

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
    lines = []
    for place in (means + i for i, angle in enumerate(angles) if angle):
        lines += [
            "s = c = 0.0",
            "for part in range(parts):",
            f"    k = {stride} * part",
            f"    s += row[k + {weights}] * sin(row[k + {place}])",
            f"    c += row[k + {weights}] * cos(row[k + {place}])",
            "middle = arctan2(s, c)",
            "for part in range(parts):",
            f"    k = {stride} * part + {place}",
            "    row[k] -= whole_turns(row[k] - middle)",
        ]
    return written_out("align", "row, parts", *lines, "None", **NAMES)
