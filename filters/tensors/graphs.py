"""Graphs of numbers on batches of tensors: each operation is one of torch for a whole batch.

autograd multiplies slopes, also those of the side that a choice discards: 0 times the infinite slope of a root at
zero is NaN. So an operation without a finite slope has a constant as its result (`slopes` has the same rule).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from filters.algebra.matrices import Matrix, Operation
from filters.algebra.tangents import completed, innovation, numbers_of
from thruster_env.graphs.folding import POSITIVE, as_single
from thruster_env.graphs.graphs import COMPARISONS, Number, needed_by

WORK: dict[str, Callable] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "pow": operator.pow,
    "negative": operator.neg,
    **COMPARISONS,
    "and": operator.and_,
    "or": operator.or_,
    "cbrt": lambda x: torch.sign(x) * abs(x) ** (1.0 / 3.0),
}
"""Operations of tensors and floats; other ones are torch's functions of tensors, by their names."""
NAMES = {"rint": "round"}

HAS_SLOPE: dict[str, Callable] = {
    "sqrt": lambda x: x > 0.0,
    "log": lambda x: x > 0.0,
    "/": lambda a, b: b != 0.0,
    "pow": lambda x, e: torch.isfinite(x**e) & ((x != 0.0) | (e >= 1.0)),
    **dict.fromkeys(("arctan2", "hypot"), lambda a, b: (a != 0.0) | (b != 0.0)),
    "cbrt": lambda x: x != 0.0,
    "log1p": lambda x: x > -1.0,
    **dict.fromkeys(("log2", "log10"), lambda x: x > 0.0),
    "arccosh": lambda x: x > 1.0,
    **dict.fromkeys(("arcsin", "arccos"), lambda x: abs(x) != 1.0),
    "arctanh": lambda x: abs(x) < 1.0,
    **dict.fromkeys(("exp", "expm1", "exp2"), lambda x: torch.isfinite(torch.exp(x))),
    **dict.fromkeys(("sinh", "cosh"), lambda x: torch.isfinite(torch.cosh(x))),
}
"""Where an operation has a finite slope, of those that do not have one everywhere."""


OF_ZERO = frozenset(HAS_SLOPE) - {"arccosh", "arctanh"}  # of these, operations that have one of a positive number


def with_finite_slope(operation: str, function: Callable, arguments: Sequence[Tensor | float]) -> Tensor:
    """The result of an operation; a constant where it has no finite slope."""
    known = [a.detach() if isinstance(a, Tensor) else a for a in arguments]
    has_slope = HAS_SLOPE[operation](*known)
    moving = function(*(torch.where(has_slope, a, 1.0) if isinstance(a, Tensor) else a for a in arguments))
    return torch.where(has_slope, moving, function(*known))


def values_of(
    wanted: Sequence[Number], order: Sequence[Number], known: Mapping[Any, Tensor], like: Tensor
) -> list[Tensor | float]:
    """Values of numbers: tensors, and floats for constants.

    Args:
        wanted: numbers of one graph.
        order: `graphs.needed_by(wanted)`.
        known: tensors of the given numbers by their names; their shapes broadcast.
        like: a tensor of the dtype and on the device of all.
    """
    values: dict[int, Tensor | float] = {}

    def tensor(value: Tensor | float) -> Tensor:
        return value if isinstance(value, Tensor) else number_like(value, like)

    for number in order:
        arguments = [values[a.place] for a in number.of]
        if number.operation == "given":
            values[number.place] = known[number.arguments[0]]
        elif number.value is not None:
            values[number.place] = number.value if like.dtype == torch.float64 else as_single(number.value)
        elif number.operation in HAS_SLOPE and not (
            number.operation in OF_ZERO and number.of[-1 if number.operation == "/" else 0].sign == POSITIVE
        ):
            function = WORK.get(number.operation) or getattr(torch, number.operation)
            values[number.place] = with_finite_slope(number.operation, function, [*map(tensor, arguments)])
        elif number.operation in WORK:
            values[number.place] = WORK[number.operation](*arguments)
        else:
            values[number.place] = getattr(torch, NAMES.get(number.operation, number.operation))(
                *map(tensor, arguments)
            )
    return [values[number.place] for number in wanted]


def number_like(value: Any, like: Tensor) -> Tensor:
    """A number as a tensor (); it is filled in on the device, without a copy from the host."""
    return like.new_full((), value) if isinstance(value, (int, float)) else like.new_tensor(value)


def stacked(values: Sequence[Tensor | float], parts: list[tuple[Tensor, ...]]) -> Tensor:
    """Components of a result as one tensor (..., rows), for the batch of all arguments."""
    like, known = parts[0][0], [tensor for part in parts for tensor in part]
    shapes = (tensor.shape for tensor in (*known, *values) if isinstance(tensor, Tensor))
    batch = torch.broadcast_shapes(*shapes)
    rows = (value if isinstance(value, Tensor) else number_like(value, like) for value in values)
    return torch.stack([row.expand(batch) for row in rows], -1)


def on_components(matrix: Matrix, arguments: Sequence[Any]) -> Tensor:
    """The value of an operation on states that turn, of `filters.algebra.tangents`.

    Args:
        matrix: the operation's result; of points and members, the last dimension, it is that of each.
        arguments: tensors for the vectors of its arguments, and the rotations.
    """
    *vectors, turns = arguments
    many = [len(vector.shape) + vector.member > 1 for vector in matrix.arguments[:-1]]
    if any(many):
        vectors = [tensor if of_each else tensor[..., None] for tensor, of_each in zip(vectors, many, strict=True)]
    parts = [tensor.unbind(-2 if any(many) else -1) for tensor in vectors]
    if matrix.operation is not innovation:
        value = _evaluated(matrix.operation, parts, turns)
    else:  # a missing number has no slope, and makes its part missing
        filled = _evaluated(completed, parts, turns).unbind(-1)
        missing = _evaluated(innovation, [[tensor.detach() for tensor in part] for part in parts], turns).isnan()
        value = torch.where(missing, torch.nan, _evaluated(innovation, [filled, parts[1]], turns))
    rows = numbers_of(matrix.operation, tuple(map(len, parts)), turns).shape
    value = value.unflatten(-1, rows) if len(rows) > 1 else value
    return value.movedim(-1 - len(rows), -1) if any(many) else value


def _evaluated(of: Operation, parts: Sequence[Sequence[Tensor]], turns: Any) -> Tensor:
    """The numbers of an operation's result, (..., numbers), at components of its vectors."""
    wanted: list[Number] = numbers_of(of, tuple(map(len, parts)), turns).ravel().tolist()
    known = {(part, k): component for part, row in enumerate(parts) for k, component in enumerate(row)}
    return stacked(values_of(wanted, needed_by(wanted), known, parts[0][0]), [tuple(part) for part in parts])
