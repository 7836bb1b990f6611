"""Where numbers lie in the memory of a filter and its derivatives, and the matrices that stand for them."""

from __future__ import annotations

from types import SimpleNamespace

from filters.pages.memory import NumbersMemory
from filters.pages.page import Page
from numerics.algebra.matrices import Matrix, given
from numerics.algebra.programs import Place
from plants.layout import number_places, starts_of
from plants.shape import Shape


class Memory(NumbersMemory):
    """The arrays of `numerics.algebra.programs`, for a model's sizes.

        rows      x, P; x and P as a stage leaves them; u, z; the score; the true x; what derivatives need
        change    of a parameter: dx, dP; d score; of the information what `notes` says, twice
        numbers   the model's; tails of two densities (`densities.tail_of`); the filter's own; weights of errors
        move      of a parameter: dQ, dR, dc, the relative size of dc; dx and dP at the start

    Matrices lie by rows. Of what lies in `rows` and `change` there is one number for each run. A filter of points
    has these during a step, X in the place of x and P.
    """

    def __init__(self, shape: Shape, page: Page):
        """Take the sizes, and the page of the filter."""
        n, m, places = shape.n, shape.m, number_places(shape.n, shape.m)
        tail = places.constants + shape.constants
        self.tail, self.predicted_tail = tail, tail + m + 2
        own = self.predicted_tail + m + 2
        x = given(Place("rows", 0), (n,))
        super().__init__(shape, page, x, given(Place("rows", n), (n, n), symmetric=True, beside=x), own)
        points = 0 if page.begin is None else page.begin(SimpleNamespace(own=self.own), x, self.P).shape[1]
        self.begun, self.notes = n + n * n, m + m * m
        self.state = max(self.begun, n * points)
        self.left, self.input, self.measured, self.level, self.true, self.length = starts_of(
            self.state, self.state, shape.inputs, m, 1, n
        )[1:]
        self.slope = self.state  # of the score
        self.noted, self.weighed, self.depth = starts_of(self.state + 1, self.notes, self.notes)[1:]
        r, c, size, self.prior, self.width = starts_of(n * n, m * m, shape.constants, 1, self.begun)[1:]
        self.X = self.beside("rows", 0, n, points)
        self.u, self.z = self.beside("rows", self.input, shape.inputs), self.beside("rows", self.measured, m)
        self.tails = [self.beside("numbers", first, m + 2) for first in (tail, self.predicted_tail)]
        self.truth = self.beside("rows", self.true, n)
        self.weights = self.beside("numbers", own + page.own_size, n, n, symmetric=True)
        self.constants_slope = self.beside("move", c, shape.constants)
        self.size = self.beside("move", size)
        self.moves: dict[Matrix, Matrix] = {
            self.x: self.beside("change", 0, n),
            self.P: self.beside("change", n, n, n, symmetric=True),
            self.Q: self.beside("move", 0, n, n, symmetric=True),
            self.R: self.beside("move", r, m, m, symmetric=True),
        }
        if points:
            self.moves[self.X] = self.beside("change", 0, n, points)
