"""Graphs of numbers, worked out of tensors: an operation of torch for each number, for a whole batch.

autograd multiplies slopes, also those of what a choice leaves out: 0 times the infinite slope of a root at zero is
NaN. Where an operation has no finite slope, its result is a constant (`slopes` has the same rule).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from thruster_env.graphs.graphs import COMPARISONS, Number, needed_by
from thruster_env.graphs.magnitudes import POSITIVE
from thruster_env.graphs.precision import as_single

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


def _divisor(one: Number) -> Number:
    """The number that decides whether an operation has a finite slope."""
    return one.of[-1 if one.operation == "/" else 0]


def with_finite_slope(operation: str, function: Callable, arguments: Sequence[Tensor | float]) -> Tensor:
    """The result of an operation; a constant where it has no finite slope."""
    known = [a.detach() if isinstance(a, Tensor) else a for a in arguments]
    has_slope = HAS_SLOPE[operation](*known)
    moving = function(*(torch.where(has_slope, a, 1.0) if isinstance(a, Tensor) else a for a in arguments))
    return torch.where(has_slope, moving, function(*known))


def order_of(wanted: Sequence[Number]) -> list[Number]:
    """The numbers that `values_of` works out, in order."""
    return needed_by(wanted)


def values_of(
    wanted: Sequence[Number], order: Sequence[Number], given: Mapping[Any, Tensor], like: Tensor
) -> list[Tensor | float]:
    """Values of numbers, of tensors for those that are given by their names; of constants floats.

    Args:
        wanted: numbers of one graph.
        order: `order_of(wanted)`.
        given: tensors whose shapes broadcast.
        like: a tensor of the dtype and on the device of all.
    """
    values: dict[int, Tensor | float] = {}

    def tensor(value: Tensor | float) -> Tensor:
        return value if isinstance(value, Tensor) else like.new_tensor(value)

    for one in order:
        arguments = [values[a.place] for a in one.of]
        if one.operation == "given":
            values[one.place] = given[one.arguments[0]]
        elif one.value is not None:
            values[one.place] = one.value if like.dtype == torch.float64 else as_single(one.value)
        elif one.operation in HAS_SLOPE and not (one.operation in OF_ZERO and _divisor(one).sign == POSITIVE):
            function = WORK.get(one.operation) or getattr(torch, one.operation)
            values[one.place] = with_finite_slope(one.operation, function, [*map(tensor, arguments)])
        elif one.operation in WORK:
            values[one.place] = WORK[one.operation](*arguments)
        else:
            values[one.place] = getattr(torch, NAMES.get(one.operation, one.operation))(*map(tensor, arguments))
    return [values[one.place] for one in wanted]
