"""Where numbers lie in the memory of a filter and its derivatives, and the matrices that stand for them."""

from __future__ import annotations

from math import prod

from filters.algebra.matrices import Matrix, input_matrix
from filters.algebra.points import root
from filters.pages.equations import PagedModel
from filters.pages.kernels import as_tuple
from filters.pages.page import NumbersMemory, Page
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Shape, number_places, starts_of


class Memory(NumbersMemory):
    """The arrays of `thruster_env.graphs.programs`, for a model's sizes.

        rows      x, P, extras; the same after a stage; u, z; the score; the true x; scratch of the slopes
        change    by parameter: dx, dP, d extras; d score; for the information `notes` numbers, twice
        numbers   the model's; tails of two densities (`densities.tail_of`); the filter's own; weights of errors
        move      by parameter: dQ, dR, dc, the relative size of dc; dx and dP at the start; d own parameters

    Matrices lie by rows. `rows` and `change` hold one number for each run. During a step, a filter of points has
    its points in the place of x and P.

    Attributes:
        predicted: the predicted quantities: x and P, or the points.
        moves: the slope of each matrix that a parameter may move, except constants and own parameters.
        constants_slope, own_slopes: slopes of the constants, and of the filter's own parameters.
    """

    def __init__(self, shape: Shape, page: Page):
        n, m, layout = shape.n, shape.m, number_places(shape.n, shape.m)
        tail = layout.constants + shape.constants
        self.tail, self.predicted_tail = tail, tail + m + 2
        own_at = self.predicted_tail + m + 2
        x = input_matrix(Place("rows", 0), (n,))
        super().__init__(shape, page, x, input_matrix(Place("rows", n), (n, n), symmetric=True, like=x), own_at)
        self.Q_root, self.prior_root = root(self.Q), root(self.P)  # where a filter starts P is that of the prior
        model = PagedModel(self)
        predicted = (x, self.P) if page.represent is None else as_tuple(page.represent(model, x, self.P))
        started = page.started(model)
        self.begun, self.notes = n + n * n, m + m * m
        starts = starts_of(*(prod(matrix.shape) for matrix in predicted))
        self.extras_from = max(self.begun, starts[-1])
        of_extras = starts_of(self.extras_from, *(prod(matrix.shape) for matrix in started.values()))[1:]
        self.state = of_extras[-1]
        self.left, self.input, self.measured, self.level, self.true, self.length = starts_of(
            self.state, self.state, shape.inputs, m, 1, n
        )[1:]
        self.slope = self.state  # of the score
        self.noted, self.weighed, self.depth = starts_of(self.state + 1, self.notes, self.notes)[1:]
        r, c, size, self.prior, own_slopes = starts_of(n * n, m * m, shape.constants, 1, self.begun)[1:]
        self.u, self.z = self.read("rows", self.input, shape.inputs), self.read("rows", self.measured, m)
        self.ratio = self.ratio_in("rows", self.input)
        self.tails = [self.read("numbers", first, m + 2) for first in (tail, self.predicted_tail)]
        self.truth = self.read("rows", self.true, n)
        self.weights = self.read("numbers", own_at + page.own_size, n, n, symmetric=True)
        self.constants_slope = self.read("move", c, shape.constants)
        self.size = self.read("move", size)
        self.moves: dict[Matrix, Matrix] = {
            self.x: self.read("change", 0, n),
            self.P: self.read("change", n, n, n, symmetric=True),
            self.Q: self.read("move", 0, n, n, symmetric=True),
            self.R: self.read("move", r, m, m, symmetric=True),
        }
        self.predicted = [self.x, self.P]
        if page.represent is not None:
            self.predicted = [self._moving(at, matrix) for at, matrix in zip(starts, predicted, strict=False)]
        self.kept = {
            name: self._moving(at, matrix) for at, (name, matrix) in zip(of_extras, started.items(), strict=False)
        }
        slopes = page.parameters(lambda offset, size: self.read("move", own_slopes + offset, *size))
        self.own_slopes = dict(zip(self.own[: len(page.own)], slopes, strict=False))

    def _moving(self, at: int, like: Matrix) -> Matrix:
        """A matrix like another one in `rows`, with its slope at the same offset in `change`."""
        value, slope = (
            self.read(array, at, *like.shape, symmetric=like.symmetric) for array in ("rows", "change")
        )
        self.moves[value] = slope
        return value
