"""A Kalman filter per particle, of the states that are not sampled: programs of all, or calls of each."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from filters.gaussian import extended
from filters.pages.equations import Equations
from filters.pages.members import of_members
from filters.pages.memory import NumbersMemory
from filters.pages.page import Page
from filters.pages.programs import stored
from filters.pages.stages import Stage, as_calls
from thruster_env.numerics.algebra.blocks import pick, zeros
from thruster_env.numerics.algebra.matrices import Matrix, given
from thruster_env.numerics.algebra.operations import sym
from thruster_env.numerics.algebra.points import root, square
from thruster_env.numerics.algebra.programs import OF_STEPS, Place
from thruster_env.numerics.compiled import inlined
from thruster_env.plants.layout import constants_reader, number_places
from thruster_env.plants.shape import Functions, Shape

NO_PAGE = Page(extended.advance, extended.settle, extended.update)  # whose parameters are none


def rows_of(shape: Shape) -> tuple[int, int, int]:
    """Rows of the table: how many a belief keeps (x, log weight, P), where v, S, log N(v; 0, S) begin, their end.

    The row of weights lies between.
    """
    kept, m = shape.n + 1 + shape.n * shape.n, shape.m
    return kept, kept + 1, kept + 2 + m + m * m


class ParticlesMemory(NumbersMemory):
    """The memory of particles with covariances: columns of the table or, `each` by itself, a copy in a row."""

    def __init__(self, shape: Shape, sampled: int, each: bool):
        """Take the sizes, and how many states are sampled."""
        n, array = shape.n, "rows" if each else "table"
        _, self.seen, end = rows_of(shape)
        x = given(Place(array, 0), (n,), member=not each)
        p = given(Place(array, n + 1), (n, n), symmetric=True, beside=x, member=not each)
        super().__init__(shape, NO_PAGE, x, p, 0)
        draws = Place("rows", end) if each else Place("draws", 0)
        self.e = given(draws, (sampled,), beside=x, member=not each)
        self.u, self.z = self.beside("given", 0, shape.inputs), self.beside("given", 0, shape.m)
        self.prior_cov = self.beside("numbers", number_places(n, shape.m).prior_cov, n, n, symmetric=True)
        self.array = array


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


def stages_of(memory: ParticlesMemory, model: Equations, sampled: tuple[int, ...]) -> dict[str, Stage]:
    """What is done with each particle: at the start, in each substep, at the end of a step, in an update."""
    x, P, e, m = memory.x, memory.P, memory.e, memory.shape.m
    *updated, v, S, level = extended.update(model, x, P, memory.z)
    y, cov, density = (Place(memory.array, memory.seen + k) for k in (0, m, m + m * m))
    predicted_x, predicted_P = extended.settle(model, x, P)
    return {
        "start": stored(sample(model.prior_mean, memory.prior_cov, e, sampled), (x, P)),
        "advance": stored(extended.advance(model, x, P, memory.u), (x, P)),
        "settle": stored(sample(predicted_x, predicted_P, e, sampled), (x, P)),
        "update": Stage({**stored(tuple(updated), (x, P)).values, y: v, cov: S, density: level}, {}),
    }


@lru_cache(maxsize=64)
def works_of(functions: Functions, shape: Shape, sampled: tuple[int, ...]) -> tuple[dict[str, Callable], int, int]:
    """The stages as functions (row, given, numbers, table, draws, size); rows of the table, numbers of the row.

    They are programs of all particles. Where the model cannot be traced or is too large, each particle is copied
    to the end of the row, and what is done with it is calls.
    """
    _, _, end = rows_of(shape)
    try:
        made = _stages(functions, shape, sampled, each=False)
        found = {name: of_members(stage, end) for name, stage in made[1].items()}
        return {name: one.work for name, one in found.items()}, max(one.rows for one in found.values()), 0
    except Exception:  # whatever a user's function raises of numbers that it does not know: it is called, then
        memory, stages, model = _stages(functions, shape, sampled, each=True)
        readers = {memory.constants: constants_reader(shape)}
        calls = {name: as_calls(one, 0, model.called, readers, OF_STEPS).values for name, one in stages.items()}
        length = end + len(sampled)
        return {name: _one_by_one(one, end, len(sampled)) for name, one in calls.items()}, end, length


def _stages(functions: Functions, shape: Shape, sampled: tuple[int, ...], *, each: bool):
    memory = ParticlesMemory(shape, len(sampled), each)
    model = Equations(functions, memory, constants_move=False, trace=not each)
    return memory, stages_of(memory, model, sampled), model


def _one_by_one(work: Callable, end: int, sampled: int) -> Callable:
    """`work(row, given, numbers)` of one particle, done with each column of the table."""

    @inlined
    def works(row, given, numbers, table, draws, size):
        width, first = table.shape[1], row.shape[0] - end - sampled
        one = row[first:]
        for j in range(width):
            for i in range(end):
                one[i] = table[i, j]
            for i in range(sampled):
                one[end + i] = draws[i * width + j]
            work(one, given, numbers)
            for i in range(end):
                table[i, j] = one[i]

    return works
