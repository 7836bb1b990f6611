"""A Kalman filter per particle, of the states that are not sampled."""

from __future__ import annotations

from functools import lru_cache, partial

from filters.gaussian import extended
from filters.pages.equations import Equations
from filters.pages.programs import stored
from filters.pages.stages import Stage
from filters.particles.each import EachMemory, Works, works_of_each
from thruster_env.numerics.algebra.blocks import pick, zeros
from thruster_env.numerics.algebra.matrices import Matrix
from thruster_env.numerics.algebra.operations import sym
from thruster_env.numerics.algebra.points import root, square
from thruster_env.plants.shape import Functions, Shape


def rows_of(shape: Shape) -> tuple[int, int, int]:
    """Rows of the table: how many a belief keeps (x, log weight, P), where v, S, log N(v; 0, S) begin, their end.

    The row of weights lies between.
    """
    kept, m = shape.n + 1 + shape.n * shape.n, shape.m
    return kept, kept + 1, kept + 2 + m + m * m


def sample(x: Matrix, P: Matrix, e: Matrix, sampled: tuple[int, ...]) -> tuple[Matrix, Matrix]:
    """Draw the sampled states of N(x, P); mean and covariance of all, if these are known.

    With the sampled states first, P = [A 0; B C] [A 0; B C]', and [x_s; x_l] = mean + [A; B] e leaves C C'.
    """
    n, count = len(x), len(sampled)
    order = (*sampled, *(i for i in range(n) if i not in sampled))
    back, places = tuple(map(order.index, range(n))), tuple(range(n))
    L = root(pick(P, order, order))
    rest = square(pick(L, back, places[count:])) if count < n else sym(zeros(P, n, n))
    return x + pick(L, back, places[:count]) @ e, rest


def stages_of(sampled: tuple[int, ...], memory: EachMemory, model: Equations) -> dict[str, Stage]:
    """What is done with each particle: at the start, in each substep, at the end of a step, in an update."""
    n, m = memory.shape.n, memory.shape.m
    _, seen, _ = rows_of(memory.shape)
    x, P, e = memory.x, memory.of_each(n + 1, n, n, symmetric=True), memory.e
    *updated, v, S, level = extended.update(model, x, P, memory.z)
    predicted_x, predicted_P = extended.settle(model, x, P)
    y, cov, density = (memory.place(seen + k) for k in (0, m, m + m * m))
    return {
        "start": stored(sample(model.prior_mean, memory.prior_cov, e, sampled), (x, P)),
        "advance": stored(extended.advance(model, x, P, memory.u), (x, P)),
        "settle": stored(sample(predicted_x, predicted_P, e, sampled), (x, P)),
        "update": Stage({**stored(tuple(updated), (x, P)).values, y: v, cov: S, density: level}, {}),
    }


@lru_cache(maxsize=64)
def works_of(functions: Functions, shape: Shape, sampled: tuple[int, ...]) -> Works:
    """The stages for a model's functions and shape."""
    _, _, end = rows_of(shape)
    return works_of_each(functions, shape, end, len(sampled), partial(stages_of, sampled))
