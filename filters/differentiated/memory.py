"""Where numbers lie in the memory of a filter and its derivatives, and the matrices that stand for them."""

from __future__ import annotations

from numerics.algebra.matrices import Matrix, given
from numerics.algebra.programs import Place
from plants.layout import number_places, starts_of
from plants.shape import Shape


class Memory:
    """The arrays of `numerics.algebra.programs`, for a model's sizes.

        rows      x, P; x and P as a stage leaves them; u, z; the score; the true x; what derivatives need
        change    of a parameter: dx, dP; d score; of the information what `notes` says, twice
        numbers   the model's; tails of two densities (`densities.tail_of`); the filter's own; weights of errors
        move      of a parameter: dQ, dR, dc, the relative size of dc; dx and dP at the start

    Matrices lie by rows. Of what lies in `rows` and `change` there is one number for each run. A filter of points
    has these during a step, X in the place of x and P.
    """

    def __init__(self, shape: Shape, points: int = 0, own: int = 0):
        """Take the sizes, and how many points and numbers of its own a filter has."""
        n, m, places = shape.n, shape.m, number_places(shape.n, shape.m)
        self.begun, self.notes = n + n * n, m + m * m
        self.shape, self.state = shape, max(self.begun, n * points)
        self.left, self.input, self.measured, self.level, self.true, self.length = starts_of(
            self.state, self.state, shape.inputs, m, 1, n
        )[1:]
        self.slope = self.state  # of the score
        self.noted, self.weighed, self.depth = starts_of(self.state + 1, self.notes, self.notes)[1:]
        r, c, size, self.prior, self.width = starts_of(n * n, m * m, shape.constants, 1, self.begun)[1:]
        tail = places.constants + shape.constants
        self.tail, self.predicted_tail = tail, tail + m + 2
        self.x = given(Place("rows", 0), (n,))
        self.P = self._beside("rows", n, n, n, symmetric=True)
        self.X = self._beside("rows", 0, n, points)
        self.u, self.z = self._beside("rows", self.input, shape.inputs), self._beside("rows", self.measured, m)
        self.Q = self._beside("numbers", places.q, n, n, symmetric=True)
        self.R = self._beside("numbers", places.r, m, m, symmetric=True)
        self.scales = self._beside("numbers", places.scales, n)
        self.constants = self._beside("numbers", places.constants, shape.constants)
        self.tails = [self._beside("numbers", first, m + 2) for first in (tail, self.predicted_tail)]
        self.truth = self._beside("rows", self.true, n)
        own_place = self.predicted_tail + m + 2
        self.own = [self._beside("numbers", own_place + k) for k in range(own)]
        self.weights = self._beside("numbers", own_place + own, n, n, symmetric=True)
        self.constants_slope = self._beside("move", c, shape.constants)
        self.size = self._beside("move", size)
        self.moves = {
            self.x: self._beside("change", 0, n),
            self.P: self._beside("change", n, n, n, symmetric=True),
            self.Q: self._beside("move", 0, n, n, symmetric=True),
            self.R: self._beside("move", r, m, m, symmetric=True),
        }
        if points:
            self.moves[self.X] = self._beside("change", 0, n, points)

    def _beside(self, array: str, first: int, *shape: int, symmetric: bool = False) -> Matrix:
        return given(Place(array, first), shape, symmetric=symmetric, beside=self.x)
