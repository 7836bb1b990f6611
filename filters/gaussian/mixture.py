"""A mixture in a row of numbers, its parts one behind the other at equal distances: entries, mean, covariance."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

from filters.gaussian import extended
from filters.pages.equations import Equations
from filters.pages.memory import RowMemory
from filters.pages.programs import programs_of, stored
from filters.pages.stages import Stage
from thruster_env.numerics.angles import NAMES, places_of
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.sources import Source, lower_pairs, written_out
from thruster_env.plants.shape import Functions, Shape


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
    row[covs] and row[weights] on. Means of parts that are angles are put on one branch
    (`thruster_env.numerics.angles`).
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


@lru_cache(maxsize=64)
def part_update(functions: Functions, shape: Shape) -> Callable:
    """Return `condition(part, z, numbers)`: the extended filter's update of a part of a mixture.

    A part is mean, covariance, weight, innovation, its covariance and log-likelihood.
    """
    n, m = shape.n, shape.m

    def stages(memory: RowMemory, model: Equations) -> list[Stage]:
        x, p = memory.read("rows", 0, n), memory.read("rows", n, n, n, symmetric=True)
        seen = n + n * n + 1
        return [stored(extended.update(model, x, p, memory.z), (x, p, seen, seen + m, seen + m + m * m))]

    return programs_of(extended.ExtendedKalmanFilter.page, functions, shape, stages).works[0]


@lru_cache(maxsize=64)
def rule_programs(functions: Functions, shape: Shape) -> tuple[Callable, Callable]:
    """Functions `predict(rule, given, numbers)` and `update(rule, given, numbers)` of one rule's Kalman filter.

    A rule is its mean, covariance, membership, innovation and the covariance of that; given are the constants of
    its affine model, then u or z.
    """
    n, m, count = shape.n, shape.m, shape.constants

    def stages(memory: RowMemory, model: Equations) -> list[Stage]:
        x, p = memory.read("rows", 0, n), memory.read("rows", n, n, n, symmetric=True)
        rule = model.at(memory.read("given", 0, count))
        u, z = memory.read("given", count, shape.inputs), memory.read("given", count, m)
        predicted = extended.settle(rule, *extended.advance(rule, x, p, u))
        *updated, _ = extended.update(rule, x, p, z)
        seen = n + n * n + 1
        return [stored(predicted, (x, p)), stored(tuple(updated), (x, p, seen, seen + m))]

    predict, update = programs_of(extended.ExtendedKalmanFilter.page, functions, shape, stages).works
    return predict, update
