"""A page's stages as functions of tensors: of a belief, an input, a measurement, and the numbers of a model.

torch's autograd then differentiates them. A vector of each member of an ensemble is a matrix (..., rows, members).
An operation without a rule here, such as a function of the model, computes on tensors itself. An ensemble's
normals are those of `thruster_env.core.streams`, on any device.

Source: Salmon, Moraes, Dror, Shaw (2011), "Parallel random numbers: as easy as 1, 2, 3"; normals by Box and Muller
(1958).
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from filters.algebra import matrices, members, operations, points, roots
from filters.algebra import operations as geometric
from filters.algebra import operations as scalars
from filters.algebra import points as densities
from filters.algebra.matrices import Matrix, Operation, in_order, never
from filters.algebra.tangents import OF_COMPONENTS, columns_in_tangent, rows_in_tangent, unit
from filters.pages.kernels import MembersMemory, Stage, stages_of
from filters.pages.kernels import member_stages_of as members_stages
from filters.pages.page import NumbersMemory, Page, PagedModel, RowMemory
from filters.tensors.graphs import on_components
from thruster_env.core.angles import TURN
from thruster_env.core.matrices import RESOLUTION
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Shape

Draw = Callable[[int, int], Tensor]
"""draw(stream, rows): standard normals (..., rows, size)."""

ROUNDS = 10
MULTIPLIERS, WEYL, LOW = (0xD2511F53, 0xCD9E8D57), (0x9E3779B9, 0xBB67AE85), 0xFFFFFFFF
FULL_TURN, TWO_TO_MINUS_32 = 2.0 * np.pi, 2.0**-32


def work_out(order: Sequence[Matrix], known: Mapping[Matrix, Tensor], like: Tensor) -> dict[Matrix, Any]:
    """Values of matrices of a graph, in an order of `matrices.in_order`, given those that are known.

    Args:
        order: the wanted matrices, each after its arguments.
        known: tensors (..., *shape) for matrices that are given.
        like: a tensor of the dtype and on the device of all.
    """
    values: dict[Matrix, Any] = dict(known)
    for matrix in order:
        if matrix not in values:
            arguments = (
                _argument_value(a, matrix, values) if isinstance(a, Matrix) else a for a in matrix.arguments
            )
            if matrix.operation in CONSTANT:
                values[matrix] = _constant(matrix.operation, matrix.arguments[0].shape, like.dtype, like.device)
            elif matrix.operation in OF_COMPONENTS:
                values[matrix] = on_components(matrix, [*arguments])
            elif matrix.operation is matrices.multiply and matrix.arguments[0].member:
                values[matrix] = _product_of_each(matrix, *arguments)
            elif matrix.operation in OF_SHAPE:
                values[matrix] = OF_SHAPE[matrix.operation](len(matrix.shape) + matrix.member, *arguments)
            else:
                values[matrix] = RULES.get(matrix.operation, matrix.operation.compute)(*arguments)
    return values


@functools.lru_cache(maxsize=256)
def _constant(operation: Operation, size: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """The value of an operation of `CONSTANT`, copied to the device once."""
    return torch.as_tensor(operation.compute(np.zeros(size)), dtype=dtype).to(device)


def _argument_value(a: Matrix, result: Matrix, values: Mapping[Matrix, Any]) -> Any:
    """The value of an argument; a number, or a vector beside those of members, gets the result's dimensions."""
    value, missing = values[a], len(result.shape) + result.member - len(a.shape) - a.member
    return value[(..., *[None] * missing)] if result.operation in BY_ENTRIES and missing else value


def _wrapped(x: Tensor) -> Tensor:
    return x - TURN * torch.ceil((x - math.pi) / TURN)


SMALL, INNER = 3, 4
"""Sizes up to which factors and products are written out: libraries are slow at batches of small matrices."""


def _product(dimensions: int, a: Tensor, b: Tensor) -> Tensor:
    return _matrix_product(a, b) if dimensions == 2 else _matrix_product(a, b[..., None])[..., 0]


def _product_of_each(matrix: Matrix, a: Tensor, b: Tensor) -> Tensor:
    """A matrix of each member, (..., rows, columns, members), by a matrix or a vector, or those of each."""
    members = "n" * matrix.arguments[1].member
    columns = "j" * (len(matrix.arguments[1].shape) > 1)
    return torch.einsum(f"...ikn,...k{columns}{members}->...i{columns}n", a, b)


def _matrix_product(a: Tensor, b: Tensor) -> Tensor:
    """A B; a short sum is written out, as factors of small matrices are."""
    if a.shape[-1] > INNER:
        return a @ b
    terms = (a[..., :, k, None] * b[..., k, None, :] for k in range(a.shape[-1]))
    return functools.reduce(operator.add, terms)


def _quotient(dimensions: int, c: Tensor, root: Tensor) -> Tensor:
    if root.shape[-1] <= SMALL:
        rows = c if dimensions == 2 else c[..., None, :]
        solution = _right_quotient(_right_quotient(rows, root, transposed=True), root)
        return solution if dimensions == 2 else solution[..., 0, :]
    right = c.mT if dimensions == 2 else c[..., None]
    solution = torch.cholesky_solve(right, root)
    return solution.mT if dimensions == 2 else solution[..., 0]


def _right_quotient(a: Tensor, lower: Tensor, *, transposed: bool = False) -> Tensor:
    """A L^-1, or A L'^-1 if transposed, column by column."""
    size = lower.shape[-1]
    columns: list[Any] = [None] * size
    for j in range(size) if transposed else reversed(range(size)):
        rest = a[..., j]
        for k in range(j) if transposed else range(j + 1, size):
            factor = lower[..., j, k] if transposed else lower[..., k, j]
            rest = rest - factor[..., None] * columns[k]
        columns[j] = rest / lower[..., j, j, None]
    return torch.stack(columns, -1)


def wrapped_where(x: Tensor, angles: tuple[bool, ...]) -> Tensor:
    """Vectors x (..., n), their angles (flags) in (-pi, pi]."""
    return _on_one_branch(1, x, angles) if any(angles) else x


def _on_one_branch(dimensions: int, x: Tensor, angles: tuple[bool, ...]) -> Tensor:
    return torch.where(_flags(dimensions, angles, x), _wrapped(x), x)


def _on_one_side(dimensions: int, y: Tensor, angles: tuple[bool, ...]) -> Tensor:
    middle = torch.atan2(y.sin().sum(-1, keepdim=True), y.cos().sum(-1, keepdim=True))
    return torch.where(_flags(dimensions, angles, y), middle + _wrapped(y - middle), y)


def _flags(dimensions: int, angles: tuple[bool, ...], like: Tensor) -> Tensor:
    flags = _flags_on(tuple(angles), like.device)
    return flags if dimensions == 1 else flags[:, None]


@functools.lru_cache(maxsize=256)
def _flags_on(angles: tuple[bool, ...], device: torch.device) -> Tensor:
    return torch.tensor(angles, device=device)


def _symmetric(a: Tensor) -> Tensor:
    return 0.5 * (a + a.mT)


def _uncorrelated(mask: Tensor, r: Tensor) -> Tensor:
    alone = torch.eye(r.shape[-1], dtype=torch.bool, device=r.device)
    return torch.where(mask[..., :, None] & mask[..., None, :] | alone, r, 0.0)


def factor(s: Tensor) -> Tensor:
    """The lower triangular L with L L' = s; NaN where s is not positive definite."""
    if s.shape[-1] <= SMALL:
        return _small_factor(s)
    lower, failed = torch.linalg.cholesky_ex(s)
    return torch.where((failed == 0)[..., None, None], lower, math.nan)


def _small_factor(s: Tensor) -> Tensor:
    columns: list[Tensor] = []
    for j in range(s.shape[-1]):
        rest = s[..., j:, j]
        for column in columns:
            rest = rest - column[..., j:] * column[..., j, None]
        pivot = rest[..., :1]
        below = rest / torch.where(pivot > 0, pivot, math.nan).sqrt()
        columns.append(torch.nn.functional.pad(below, (j, 0)))
    return torch.stack(columns, dim=-1)


def density(v: Tensor, root: Tensor, mask: Tensor) -> Tensor:
    """Log N(v; 0, L L') of the entries that are seen, for L = root, (...)."""
    scaled = _forward_quotient(root, v)
    logs = torch.log(torch.diagonal(root, dim1=-2, dim2=-1)) + densities.LEVEL
    return -0.5 * (scaled * scaled).sum(-1) - torch.where(mask, logs, 0.0).sum(-1)


def _forward_quotient(lower: Tensor, v: Tensor) -> Tensor:
    if lower.shape[-1] <= SMALL:
        return _right_quotient(v[..., None, :], lower, transposed=True)[..., 0, :]
    return torch.linalg.solve_triangular(lower, v[..., None], upper=False)[..., 0]


def root(p: Tensor) -> Tensor:
    """`points.root`, column by column."""
    resolution = RESOLUTION * torch.finfo(p.dtype).eps / torch.finfo(torch.float64).eps
    columns: list[Tensor] = []
    for j in range(p.shape[-1]):
        rest = p[..., j:, j]
        for column in columns:
            rest = rest - column[..., j:] * column[..., j, None]
        singular = rest[..., :1] <= resolution * p[..., j, j, None]
        pivot = torch.where(singular, 1.0, rest[..., :1]).sqrt()
        below = torch.where(singular, 0.0, rest / pivot)
        columns.append(torch.nn.functional.pad(below, (j, 0)))
    return torch.stack(columns, dim=-1)


def where(condition: Tensor, a: Tensor, b: Tensor, dimensions: int) -> Tensor:
    """`a` or `b`, each with so many dimensions beside those of the batch, which the condition has alone."""
    return torch.where(condition[(..., *[None] * dimensions)], a, b)


def _reciprocal(a: Tensor) -> Tensor:
    """1/a; infinite, and without a slope, where a is zero, so that what is not chosen has no NaN for a slope."""
    return torch.where(a == 0, math.inf, 1.0 / torch.where(a == 0, 1.0, a))


def _triangle(a: Tensor) -> Tensor:
    rows, columns = list(a.unbind(-2)), []
    for i, row in enumerate(rows):
        square = (row * row).sum(-1, keepdim=True)
        length = torch.where(square > 0, square, 1.0).sqrt()
        direction = torch.where(square > 0, row / length, 0.0)
        below = [(direction * other).sum(-1, keepdim=True) for other in rows[i + 1 :]]
        rows[i + 1 :] = [other - part * direction for other, part in zip(rows[i + 1 :], below, strict=True)]
        column = torch.cat([torch.where(square > 0, length, 0.0), *below], -1)
        columns.append(torch.nn.functional.pad(column, (i, 0)))
    return torch.stack(columns, -1)


def _joined(dimension: int, a: Tensor, b: Tensor) -> Tensor:
    batch = torch.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    return torch.cat([tensor.expand(*batch, -1, -1) for tensor in (a, b)], dimension)


def _hats(u: Tensor, nodes: Tensor) -> Tensor:
    """`points.hats`: of neighbours the part of the way between them."""
    part = ((u - nodes[..., :-1]) / nodes.diff(dim=-1)).clamp(0.0, 1.0)
    return torch.nn.functional.pad(part, (1, 0), value=1.0) - torch.nn.functional.pad(part, (0, 1))


def _covariance(x: Tensor, y: Tensor) -> Tensor:
    return _matrix_product(_deviations(x), _deviations(y).mT) / (x.shape[-1] - 1)


def _deviations(x: Tensor) -> Tensor:
    return x - x.mean(-1, keepdim=True)


def _stretches(before: Tensor, after: Tensor, part: Tensor) -> Tensor:
    """`members.stretches`; where nothing is left there is no slope."""
    positive = after > 0
    ratio = torch.where(positive & (before > 0), before, 1.0) / torch.where(positive, after, 1.0)
    lost = torch.where(before > 0, ratio.sqrt(), 0.0) - 1.0
    return torch.where(positive, 1.0 + part[..., None] * lost, 1.0)


def _geometric_mean(a: Tensor, b: Tensor) -> Tensor:
    if a.shape[-1] == 1:
        return (a * b).sqrt()
    of_a, of_b = _unit(factor(a)), _unit(factor(b))
    a, b = a / of_a, b / of_b
    for _ in range(geometric.rounds(a.shape[-1])):
        both = a + b
        of = factor(both)
        unit = _unit(of)
        a, b = both / unit, _symmetric(_quotient(2, a, of) @ b) * unit
    return a * (of_a * of_b).sqrt()


def _unit(root: Tensor) -> Tensor:
    """A matrix over this has determinant 1, of its root."""
    return (2.0 * torch.diagonal(root, dim1=-2, dim2=-1).log().mean(-1)).exp()[..., None, None]


BY_ENTRIES = {matrices.add, matrices.subtract, matrices.scale, matrices.entries_product, scalars.choose}
CONSTANT = {operations.eye, points.units, points.ones}  # depend on the sizes of their arguments alone
OF_SHAPE: dict[Operation, Callable] = {
    matrices.multiply: _product,
    operations.quotient: _quotient,
    operations.mask_missing: lambda size, mask, a: torch.where(mask if size == 1 else mask[..., None], a, 0.0),
    operations.on_one_branch: _on_one_branch,
    points.on_one_side: _on_one_side,
    members.on_one_branch: _on_one_side,
}
"""Rules that first take whether the result is a vector or a matrix."""
RULES: dict[Operation, Callable] = {
    matrices.transposed: lambda a: a.mT,
    matrices.reciprocal: _reciprocal,
    operations.mirrored: _symmetric,
    operations.congruence: lambda a, p, pa: _symmetric(_matrix_product(a, pa)),
    operations.present: lambda z: z == z,
    operations.uncorrelated: _uncorrelated,
    operations.factor: factor,
    operations.inverse: lambda root, mask: torch.cholesky_inverse(root),
    densities.density: density,
    densities.dot: lambda a, b: (a * b).sum(-1),
    points.root: root,
    points.outer: lambda a, b: a[..., :, None] * b[..., None, :],
    points.square: lambda a: _matrix_product(a, a.mT),
    points.first: lambda a: a[..., 0],
    points.without_first: lambda a: a[..., 1:],
    scalars.choose: torch.where,
    scalars.exceeds: lambda a, value: a > value,
    scalars.is_number: lambda a: a == a,
    scalars.trace: lambda a: torch.diagonal(a, dim1=-2, dim2=-1).sum(-1),
    scalars.count: lambda mask: mask.sum(-1),  # a whole number, which leaves the precision of others
    scalars.exponential: torch.exp,
    scalars.at_most: lambda v, value: torch.clamp(v, max=value),
    scalars.at_least: lambda a, value: torch.where(a > value, a, value),
    scalars.diagonal: torch.diag_embed,
    points.hats: _hats,
    roots.inverted: lambda root: _symmetric(torch.cholesky_inverse(root)),
    roots.triangle: _triangle,
    roots.hstack: lambda a, b: _joined(-1, a, b),
    roots.vstack: lambda a, b: _joined(-2, a, b),
    roots.part: lambda a, top, left, rows, columns: a[..., top : top + rows, left : left + columns],
    roots.zeros: lambda a, *shape: a.new_zeros(shape),
    roots.factor_of: lambda lower: lower,
    roots.forward_quotient: _forward_quotient,
    roots.triangle_quotient: lambda a, lower: torch.linalg.solve_triangular(lower, a, upper=False, left=False),
    members.mean: lambda x: x.mean(-1),
    members.variances: lambda x: x.var(-1),
    members.cross_covariance: _covariance,
    members.scatter: lambda x: _covariance(x, x),
    members.centred: lambda e: _deviations(e) * (e.shape[-1] / (e.shape[-1] - 1.0)) ** 0.5,
    members.stretches: _stretches,
    geometric.geometric_mean: _geometric_mean,
}
"""Rules of others; sums, products and powers are those of tensors."""


NORMALS = Place("draws", 0)


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
        super().__init__(memory)
        n, channels = memory.shape.n, memory.shape.channels
        self._f, self._h = _Operations(f, n, n), _Operations(h, channels, n)

    def f(self, x: Matrix, u: Matrix) -> Matrix:
        """The state, a substep after x; of points (n, points) that of each."""
        return unit(self._f.value_at(x, u, self._constants), self.turns)

    def F(self, x: Matrix, u: Matrix) -> Matrix:  # noqa: N802
        """df/dx, of a state with rotations in the tangents at x and f(x, u), (t, t)."""
        both = self._f.both(x, u, self._constants)
        columns = columns_in_tangent(self._f.matrix(both), x, self.turns)
        return rows_in_tangent(columns, self._f.value(both), self.turns)

    def h(self, x: Matrix) -> Matrix:
        """What is measured at x; of points (n, points) at each."""
        return self._h.value_at(x, *self._seen())

    def H(self, x: Matrix) -> Matrix:  # noqa: N802
        """dh/dx, of a state with rotations in the tangent at x, (channels, t)."""
        return columns_in_tangent(self._h.matrix(self._h.both(x, *self._seen())), x, self.turns)


class _Operations:
    """An equation as operations on Matrices; its value and its Jacobian are evaluated together."""

    def __init__(self, equation: Equation, rows: int, n: int):
        self.both = Operation(equation.with_jacobian, lambda *_: (), never)
        self.of_points = Operation(equation.of_points, lambda x, *_: (rows, x[1]), never)
        self.of_members = Operation(equation.of_points, lambda *_: (rows,), never)
        self.value = Operation(lambda both: both[0], lambda _: (rows,), never)
        self.matrix = Operation(lambda both: both[1], lambda _: (rows, n), never)

    def value_at(self, x: Matrix, *arguments: Matrix) -> Matrix:
        if x.member:
            return self.of_members(x, *arguments)
        return self.value(self.both(x, *arguments)) if len(x.shape) == 1 else self.of_points(x, *arguments)


class _Part:
    """A stage, of tensors in the places that it reads."""

    def __init__(self, stage: Stage):
        self._wanted = dict(stage.stores[0])
        self._order = in_order(list(self._wanted.values()))
        self.inputs = [matrix for matrix in self._order if isinstance(matrix.operation, Place)]

    def __call__(self, tensors: Mapping[Place, Tensor], like: Tensor) -> dict[Place, Tensor]:
        values = work_out(self._order, {matrix: tensors[matrix.operation] for matrix in self.inputs}, like)
        return {target: values[matrix] for target, matrix in self._wanted.items()}


class Stages:
    """The functions of a page, for a model's equations.

    A belief is mean, covariance and extras by name; `draw(stream, rows)` returns an ensemble's normals.

    Attributes:
        memory: the layout of a filter's numbers.
        reads: the matrices that the page reads.
        extra_dimensions: dimensions of the extras, besides those of a batch.
    """

    memory: NumbersMemory

    def __init__(self, f: Equation, h: Equation, shape: Shape, page: Page):
        self.memory = memory = RowMemory(shape, page)
        stages = stages_of(page, memory, TensorModel(f, h, memory))
        parts = [*map(_Part, stages)]
        self._start, self._represent, self._propagate, self._add_process_noise, self._update = parts
        self.reads = {matrix for part in parts for matrix in part.inputs}
        self._belief, self._outputs = memory.belief, memory.outputs
        self._extras = {name: matrix.operation for name, matrix in memory.extras.items()}
        self.extra_dimensions = {name: len(matrix.shape) for name, matrix in memory.extras.items()}

    def start(self, numbers: Mapping[Place, Tensor], prior: tuple[Tensor, Tensor], draw: Draw) -> tuple:
        """The belief at the prior, of its mean and covariance."""
        started = self._start(numbers, prior[0])
        return *prior, {name: started[source] for name, source in self._extras.items()}

    def predict(
        self, numbers: Mapping[Place, Tensor], belief: tuple, u: Tensor, substeps: int, draw: Draw
    ) -> tuple:
        """The belief a step later."""
        tensors = self._tensors(numbers, belief, u)
        for part in (self._represent, *[self._propagate] * substeps, self._add_process_noise):
            tensors |= part(tensors, belief[0])
        return self._belief_of(tensors)

    def update(self, numbers: Mapping[Place, Tensor], belief: tuple, z: Tensor, draw: Draw) -> tuple[tuple, list]:
        """The belief after the measurement z; then the innovation, its covariance and its log density."""
        tensors = self._tensors(numbers, belief, z)
        tensors |= self._update(tensors, belief[0])
        return self._belief_of(tensors), [tensors[source] for source in self._outputs]

    def _tensors(self, numbers: Mapping[Place, Tensor], belief: tuple, argument: Tensor) -> dict[Place, Tensor]:
        *known, extras = belief
        rows = dict(zip(self._belief, known, strict=True)) | {
            self._extras[name]: extra for name, extra in extras.items()
        }
        return {**numbers, **rows, Place("given", 0): argument}

    def _belief_of(self, tensors: Mapping[Place, Tensor]) -> tuple:
        return *(tensors[at] for at in self._belief), {name: tensors[at] for name, at in self._extras.items()}


class EnsembleStages(Stages):
    """The stages of an ensemble, which keeps its members (..., n, N)."""

    def __init__(self, f: Equation, h: Equation, shape: Shape, page: Page):
        self.memory = memory = MembersMemory(shape, page)
        parts = {
            name: _Part(stage) for name, stage in members_stages(page, memory, TensorModel(f, h, memory)).items()
        }
        self._parts = parts
        self.reads = {matrix for part in parts.values() for matrix in part.inputs}
        self._belief, self._outputs = memory.belief, memory.outputs
        matrices = {"members": memory.x, **memory.extras}
        self._extras = {name: matrix.operation for name, matrix in matrices.items()}
        self.extra_dimensions = {name: len(matrix.shape) + matrix.member for name, matrix in matrices.items()}

    def start(self, numbers: Mapping[Place, Tensor], prior: tuple[Tensor, Tensor], draw: Draw) -> tuple:
        """The members at the prior, their mean and covariance."""
        tensors = {**numbers, NORMALS: draw(FILTER_PRIOR, self.memory.shape.t)}
        mean, cov, extras = self._after(tensors, ("start", "summarise"), prior[0])
        batch = prior[0].shape[:-1]
        extras = {
            name: extra.expand(*batch, *extra.shape[extra.ndim - self.extra_dimensions[name] :])
            for name, extra in extras.items()
        }
        return mean.expand(*batch, -1), cov.expand(*batch, -1, -1), extras

    def predict(
        self, numbers: Mapping[Place, Tensor], belief: tuple, u: Tensor, substeps: int, draw: Draw
    ) -> tuple:
        """The belief a step later."""
        tensors = self._tensors(numbers, belief, u)
        tensors[NORMALS] = draw(FILTER_PROCESS, self.memory.shape.t)
        return self._after(tensors, (*["propagate"] * substeps, "add_process_noise", "summarise"), belief[0])

    def update(self, numbers: Mapping[Place, Tensor], belief: tuple, z: Tensor, draw: Draw) -> tuple[tuple, list]:
        """The belief after the measurement z; then the innovation, its covariance and its log density."""
        tensors = self._tensors(numbers, belief, z)
        if any(matrix.operation == NORMALS for matrix in self._parts["update"].inputs):
            tensors[NORMALS] = draw(FILTER_MEASUREMENT, self.memory.shape.m)
        updated = self._after(tensors, ("update",), belief[0])
        return updated, [tensors[source] for source in self._outputs]

    def _after(self, tensors: dict[Place, Tensor], names: Sequence[str], like: Tensor) -> tuple:
        for name in names:
            tensors |= self._parts[name](tensors, like)
        return self._belief_of(tensors)
