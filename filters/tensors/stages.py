"""A page's stages as functions of tensors: of a belief, an input, a measurement, and the numbers of a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from filters.algebra.matrices import Matrix, Operation, in_order, never
from filters.pages.equations import PagedModel
from filters.pages.kernels import stages_of
from filters.pages.members import MembersMemory
from filters.pages.members import stages_of as members_stages
from filters.pages.memory import NumbersMemory, RowMemory
from filters.pages.page import Page
from filters.pages.stages import Stage
from filters.tensors.algebra import work_out
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, normal_block
from thruster_env.graphs.programs import Place
from thruster_env.model.layout import LANES, padded
from thruster_env.model.shape import Shape

NORMALS = Place("draws", 0)
Draw = Callable[[int, int], Tensor]


class Equation(Protocol):
    """An equation of a model, y = f(x, u, c) or h(x, c), of tensors."""

    @property
    def with_jacobian(self) -> Callable[..., Any]:
        """A function (x, ..., c) of x (..., n) that returns y (..., rows) and dy/dx (..., rows, n)."""

    @property
    def of_points(self) -> Callable[..., Any]:
        """A function (X, ..., c) of points X (..., n, points) that returns the values (..., rows, points)."""


class TensorModel(PagedModel):
    """A model as a page sees it, whose equations are those of tensors."""

    def __init__(self, f: Equation, h: Equation, memory: NumbersMemory):
        """Take the equations, and where all numbers lie."""
        super().__init__(memory)
        n, m = memory.shape.n, memory.shape.m
        self._f, self._h = _Operations(f, n, n), _Operations(h, m, n)

    def f(self, x: Matrix, u: Matrix) -> Matrix:
        """The state, a substep after x; of points (n, points) that of each."""
        return self._f.value_at(x, u, self._constants)

    def F(self, x: Matrix, u: Matrix) -> Matrix:  # noqa: N802
        """df/dx."""
        return self._f.matrix(self._f.both(x, u, self._constants))

    def h(self, x: Matrix) -> Matrix:
        """What is measured at x; of points (n, points) at each."""
        return self._h.value_at(x, self._constants)

    def H(self, x: Matrix) -> Matrix:  # noqa: N802
        """dh/dx."""
        return self._h.matrix(self._h.both(x, self._constants))


class _Operations:
    """An equation as operations on Matrices; its value and its Jacobian are worked out together."""

    def __init__(self, equation: Equation, rows: int, n: int):
        self.both = Operation(equation.with_jacobian, lambda *_: (), never)
        self.of_points = Operation(equation.of_points, lambda x, *_: (rows, x[1]), never)
        self.of_members = Operation(equation.of_points, lambda *_: (rows,), never)
        self.value = Operation(lambda both: both[0], lambda _: (rows,), never)
        self.matrix = Operation(lambda both: both[1], lambda _: (rows, n), never)

    def value_at(self, x: Matrix, *others: Matrix) -> Matrix:
        if x.member:
            return self.of_members(x, *others)
        return self.value(self.both(x, *others)) if len(x.shape) == 1 else self.of_points(x, *others)


class _Part:
    """A stage, of tensors in the places that it reads."""

    def __init__(self, stage: Stage):
        self._wanted = dict(stage.stores[0])
        self._order = in_order(list(self._wanted.values()))
        self.given = [one for one in self._order if isinstance(one.operation, Place)]

    def __call__(self, tensors: Mapping[Place, Tensor], like: Tensor) -> dict[Place, Tensor]:
        found = work_out(self._order, {one: tensors[one.operation] for one in self.given}, like)
        return {place: found[one] for place, one in self._wanted.items()}


def normals_of(key: np.ndarray, step: int, size: int, like: Tensor) -> Draw:
    """What draws normals (..., rows, size) of a stream for keys (..., 2), those of `filters.run`."""
    width = padded(size, LANES)

    def draw(stream: int, rows: int) -> Tensor:
        words = (key[..., k, None] for k in range(2))
        found = np.stack(normal_block(np.arange(rows * width // 4), step, stream, *words), axis=-1)
        found = found.reshape(*key.shape[:-1], rows, width)[..., :size]
        return torch.as_tensor(found, dtype=like.dtype, device=like.device)

    return draw


class Stages:
    """The functions of a page, for a model's equations.

    A belief is mean, covariance and what is kept, by names; `draw(stream, rows)` are an ensemble's normals.

    Attributes:
        memory: where a filter's numbers lie.
        reads: which of them the page reads.
        kept: dimensions of what a filter keeps, beside those of a batch.
    """

    memory: NumbersMemory

    def __init__(self, f: Equation, h: Equation, shape: Shape, page: Page):
        """Make graphs of matrices of the page."""
        self.memory = memory = RowMemory(shape, page)
        stages = stages_of(page, memory, TensorModel(f, h, memory))
        parts = self._start, self._begin, self._advance, self._settle, self._update = [*map(_Part, stages)]
        self.reads = {one for part in parts for one in part.given}
        self._belief, self._told = memory.belief, memory.told
        self._kept = {name: one.operation for name, one in memory.kept.items()}
        self.kept = {name: len(one.shape) for name, one in memory.kept.items()}

    def start(self, numbers: Mapping[Place, Tensor], prior: tuple[Tensor, Tensor], draw: Draw) -> tuple:
        """The belief at the prior, of its mean and covariance."""
        found = self._start(numbers, prior[0])
        return *prior, {name: found[place] for name, place in self._kept.items()}

    def predict(
        self, numbers: Mapping[Place, Tensor], belief: tuple, u: Tensor, substeps: int, draw: Draw
    ) -> tuple:
        """The belief a step later."""
        tensors = self._tensors(numbers, belief, u)
        for part in (self._begin, *[self._advance] * substeps, self._settle):
            tensors |= part(tensors, belief[0])
        return self._belief_of(tensors)

    def update(self, numbers: Mapping[Place, Tensor], belief: tuple, z: Tensor, draw: Draw) -> tuple[tuple, list]:
        """The belief after the measurement z; then the innovation, its covariance and its log density."""
        tensors = self._tensors(numbers, belief, z)
        tensors |= self._update(tensors, belief[0])
        return self._belief_of(tensors), [tensors[place] for place in self._told]

    def _tensors(self, numbers: Mapping[Place, Tensor], belief: tuple, given: Tensor) -> dict[Place, Tensor]:
        *known, kept = belief
        rows = dict(zip(self._belief, known, strict=True)) | {self._kept[name]: one for name, one in kept.items()}
        return {**numbers, **rows, Place("given", 0): given}

    def _belief_of(self, tensors: Mapping[Place, Tensor]) -> tuple:
        return *(tensors[at] for at in self._belief), {name: tensors[at] for name, at in self._kept.items()}


class EnsembleStages(Stages):
    """The same of an ensemble, which keeps its members (..., n, N)."""

    def __init__(self, f: Equation, h: Equation, shape: Shape, page: Page):
        """Make graphs of matrices of the page."""
        self.memory = memory = MembersMemory(shape, page)
        parts = {name: _Part(one) for name, one in members_stages(page, memory, TensorModel(f, h, memory)).items()}
        self._parts = parts
        self.reads = {one for part in parts.values() for one in part.given}
        self._belief, self._told = memory.belief, memory.told
        kept = {"members": memory.x, **memory.kept}
        self._kept = {name: one.operation for name, one in kept.items()}
        self.kept = {name: len(one.shape) + one.member for name, one in kept.items()}

    def start(self, numbers: Mapping[Place, Tensor], prior: tuple[Tensor, Tensor], draw: Draw) -> tuple:
        """The members at the prior, their mean and covariance."""
        tensors = {**numbers, NORMALS: draw(FILTER_PRIOR, self.memory.shape.n)}
        mean, cov, kept = self._after(tensors, ("start", "summarise"), prior[0])
        batch = prior[0].shape[:-1]
        kept = {name: one.expand(*batch, *one.shape[one.ndim - self.kept[name] :]) for name, one in kept.items()}
        return mean.expand(*batch, -1), cov.expand(*batch, -1, -1), kept

    def predict(
        self, numbers: Mapping[Place, Tensor], belief: tuple, u: Tensor, substeps: int, draw: Draw
    ) -> tuple:
        """The belief a step later."""
        tensors = self._tensors(numbers, belief, u)
        tensors[NORMALS] = draw(FILTER_PROCESS, self.memory.shape.n)
        return self._after(tensors, (*["advance"] * substeps, "settle", "summarise"), belief[0])

    def update(self, numbers: Mapping[Place, Tensor], belief: tuple, z: Tensor, draw: Draw) -> tuple[tuple, list]:
        """The belief after the measurement z; then the innovation, its covariance and its log density."""
        tensors = self._tensors(numbers, belief, z)
        if any(one.operation == NORMALS for one in self._parts["update"].given):
            tensors[NORMALS] = draw(FILTER_MEASUREMENT, self.memory.shape.m)
        found = self._after(tensors, ("update",), belief[0])
        return found, [tensors[place] for place in self._told]

    def _after(self, tensors: dict[Place, Tensor], names: Sequence[str], like: Tensor) -> tuple:
        for name in names:
            tensors |= self._parts[name](tensors, like)
        return self._belief_of(tensors)
