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

        rows      x, P, what is kept; the same as a stage leaves it; u, z; the score; the true x; what slopes need
        change    of a parameter: dx, dP, d of what is kept; d score; of the information what `notes` says, twice
        numbers   the model's; tails of two densities (`densities.tail_of`); the filter's own; weights of errors
        move      of a parameter: dQ, dR, dc, the relative size of dc; dx and dP at the start; of the filter's own

    Matrices lie by rows. Of what lies in `rows` and `change` there is one number for each run. A filter of points
    has these during a step, in the place of x and P.

    Attributes:
        flying: what is predicted: x and P, or the points.
        moves: the slope of each matrix that a parameter may move, but those of the next two.
        constants_slope, own_slopes: those of the constants, and of the filter's own parameters.
    """

    def __init__(self, shape: Shape, page: Page):
        """Take the sizes, and the page of the filter."""
        n, m, places = shape.n, shape.m, number_places(shape.n, shape.m)
        tail = places.constants + shape.constants
        self.tail, self.predicted_tail = tail, tail + m + 2
        own = self.predicted_tail + m + 2
        x = input_matrix(Place("rows", 0), (n,))
        super().__init__(shape, page, x, input_matrix(Place("rows", n), (n, n), symmetric=True, like=x), own)
        self.Q_root, self.prior_root = root(self.Q), root(self.P)  # where a filter starts P is that of the prior
        model = PagedModel(self)
        flying = (x, self.P) if page.represent is None else as_tuple(page.represent(model, x, self.P))
        started = page.started(model)
        self.begun, self.notes = n + n * n, m + m * m
        starts = starts_of(*(prod(one.shape) for one in flying))
        self.kept_from = max(self.begun, starts[-1])
        of_kept = starts_of(self.kept_from, *(prod(one.shape) for one in started.values()))[1:]
        self.state = of_kept[-1]
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
        self.weights = self.read("numbers", own + page.own_size, n, n, symmetric=True)
        self.constants_slope = self.read("move", c, shape.constants)
        self.size = self.read("move", size)
        self.moves: dict[Matrix, Matrix] = {
            self.x: self.read("change", 0, n),
            self.P: self.read("change", n, n, n, symmetric=True),
            self.Q: self.read("move", 0, n, n, symmetric=True),
            self.R: self.read("move", r, m, m, symmetric=True),
        }
        self.flying = [self.x, self.P]
        if page.represent is not None:
            self.flying = [self._moving(*one) for one in zip(starts, flying, strict=False)]
        self.kept = {
            name: self._moving(at, one) for at, (name, one) in zip(of_kept, started.items(), strict=False)
        }
        slopes = page.parameters(lambda place, size: self.read("move", own_slopes + place, *size))
        self.own_slopes = dict(zip(self.own[: len(page.own)], slopes, strict=False))

    def _moving(self, at: int, like: Matrix) -> Matrix:
        """A matrix like another one that lies in `rows`, and its slope at the same place in `change`."""
        made, slope = (self.read(array, at, *like.shape, symmetric=like.symmetric) for array in ("rows", "change"))
        self.moves[made] = slope
        return made
