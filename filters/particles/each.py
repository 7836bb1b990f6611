"""What pages say of each particle, as programs of all particles, or calls for one after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from filters.gaussian import extended
from filters.pages.equations import Equations
from filters.pages.members import of_members
from filters.pages.memory import NumbersMemory
from filters.pages.page import Page
from filters.pages.stages import Stage, as_calls
from thruster_env.numerics.algebra.matrices import Matrix, given
from thruster_env.numerics.algebra.programs import OF_STEPS, Place
from thruster_env.numerics.compiled import inlined
from thruster_env.plants.layout import constants_reader, number_places
from thruster_env.plants.shape import Functions, Shape

NO_PAGE = Page(extended.advance, extended.settle, extended.update)  # of which only the parameters count: none


class EachMemory(NumbersMemory):
    """The memory of particles: columns of the table and draws or, taken one by one, of a copy in a row.

    Attributes:
        x, e: of each particle, its state and `draws` normals.
        u, z: of all.
    """

    def __init__(self, shape: Shape, end: int, draws: int, common: int, apart: bool):
        """Take the sizes, how many rows of the table are used, and whether particles are taken one by one.

        From `common` on the row has numbers that all particles share.
        """
        self._common = Place("rows", end + draws if apart else common)
        self._array, self._member = ("rows" if apart else "table"), not apart
        x = given(self.place(0), (shape.n,), member=not apart)
        super().__init__(shape, NO_PAGE, x, x, 0)
        at = Place("rows", end) if apart else Place("draws", 0)
        self.e = given(at, (draws,), like=x, member=not apart)
        self.u, self.z = self.read("given", 0, shape.inputs), self.read("given", 0, shape.m)
        self.prior_cov = self.read(
            "numbers", number_places(shape.n, shape.m).prior_cov, shape.n, shape.n, symmetric=True
        )

    def place(self, first: int) -> Place:
        """Where rows of the table begin."""
        return Place(self._array, first)

    def of_each(self, first: int, *shape: int, symmetric: bool = False) -> Matrix:
        """What each particle has in the table from a row on."""
        return given(self.place(first), shape, symmetric=symmetric, like=self.x, member=self._member)

    def of_all(self, *shape: int, symmetric: bool = False) -> Matrix:
        """What all particles share."""
        return given(self._common, shape, symmetric=symmetric, like=self.x)


class Works(NamedTuple):
    """Stages as functions (row, given, numbers, table, draws, size), and the memory that they need."""

    works: dict[str, Callable]
    rows: int  # of the table
    length: int  # of scratch at the end of the row


def works_of_each(
    functions: Functions,
    shape: Shape,
    end: int,
    draws: int,
    stages: Callable[[EachMemory, Equations], dict[str, Stage]],
    common: tuple[int, int] = (0, 0),
) -> Works:
    """Stages of a model's particles, which use rows of the table before `end`, and so many normals each.

    They share numbers of the row: from which place on, and how many.

    They are programs of all particles. Where the model cannot be traced or is too large, each particle is copied
    to the end of the row, and what is done with it is calls.
    """

    def seen(apart: bool) -> tuple[EachMemory, Equations]:
        memory = EachMemory(shape, end, draws, common[0], apart)
        return memory, Equations(functions, memory, constants_move=False, trace=not apart)

    try:
        found = {name: of_members(stage, end) for name, stage in stages(*seen(apart=False)).items()}
        return Works({name: one.work for name, one in found.items()}, max(one.rows for one in found.values()), 0)
    except Exception:  # whatever a user's function raises of numbers that it does not know: it is called, then
        memory, model = seen(apart=True)
        made, readers = stages(memory, model), {memory.constants: constants_reader(shape)}
        calls = {name: as_calls(one, 0, model.called, readers, OF_STEPS).values for name, one in made.items()}
        length = end + draws + common[1]
        return Works({name: _one_by_one(one, end, draws, *common) for name, one in calls.items()}, end, length)


def _one_by_one(work: Callable, end: int, count: int, common: int, shared: int) -> Callable:
    """`work(row, given, numbers)` of one particle, done with each column of the table."""

    @inlined
    def works(row, given, numbers, table, draws, size):
        width, one = table.shape[1], row[row.shape[0] - end - count - shared :]
        for i in range(shared):
            one[end + count + i] = row[common + i]
        for j in range(width):
            for i in range(end):
                one[i] = table[i, j]
            for i in range(count):
                one[end + i] = draws[i * width + j]
            work(one, given, numbers)
            for i in range(end):
                table[i, j] = one[i]

    return works
