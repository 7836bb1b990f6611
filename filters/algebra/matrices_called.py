"""Operations on matrices as functions made for their sizes, for `calls`: of tuples, or in loops over arrays."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import prod
from typing import Any

import numpy as np

from filters.algebra import (
    blocks_called,
    densities,
    geometric,
    matrices,
    members_called,
    operations,
    points_called,
    upper_called,
)
from filters.algebra.blocks_called import by_entries
from filters.algebra.matrices import Matrix, Operation
from thruster_env.core import matrices as made
from thruster_env.core.angles import NAMES, short_way
from thruster_env.core.sources import Source, entrywise, written_out


def arguments_of(one: Matrix) -> tuple[Matrix, ...]:
    """What the function of an operation takes."""
    if _by_transpose(one):
        return one.arguments[0], one.arguments[1].arguments[0]
    if one.operation is operations.congruence:
        return one.arguments[0], one.arguments[2]
    if one.operation is operations.of_best_gain:  # of P, C = P H' and K it is P - C K'
        return one.arguments[1], one.arguments[2], one.arguments[4]
    return () if one.operation is operations.eye else one.of


def _by_transpose(one: Matrix) -> bool:
    """Whether a product is by a transposed matrix, which functions do not form."""
    return one.operation is matrices.multiply and one.arguments[1].operation is matrices.transposed


def function_of(one: Matrix) -> Callable:
    """The function that works out an operation of ours, of what `arguments_of` says."""
    others = tuple(a for a in one.arguments if not isinstance(a, Matrix))
    return _function(one.operation, one.shape, _by_transpose(one), others, *(a.shape for a in one.of))


@cache
def _function(operation: Operation, result: tuple, by_transpose: bool, others: tuple, *shapes: tuple) -> Callable:
    """The same for all operations alike: compiled code then has it once."""
    if operation is matrices.multiply:
        return _product(by_transpose, *shapes)
    if operation not in _FUNCTIONS:
        raise ValueError(f"{operation.name} is for models that are small and can be traced, but this one is not")
    return _FUNCTIONS[operation](result, *others, *shapes)


def _multiple(result: tuple, *others) -> Callable:
    return by_entries("{a} * {0!r}" if isinstance(others[0], float) else "{a} * {b}")(result, *others)


def _product(by_transpose: bool, a: tuple, b: tuple) -> Callable:
    if len(b) == 1:
        return made.vector_multiplier(*a)
    return made.transposed_multiplier(*a, b[1]) if by_transpose else made.multiplier(*a, b[1])


def _mirrored(shape: tuple, *of: tuple) -> Callable:
    source = Source("mirrored", "a", result=shape, a=shape)
    return source.function(source.symmetric("s", shape[0], lambda i, j: f"a[{i}][{j}]"))


def _congruence(shape: tuple, a: tuple, p: tuple, pa: tuple) -> Callable:
    names: dict[str, Any] = {"times": made.multiplier(*a, a[0]), "mirror": _mirrored(shape, shape)}
    return written_out("congruence", "a, pa", "mirror(times(a, pa))", **names)


def _of_best_gain(shape: tuple, value: tuple, p: tuple, c: tuple, s: tuple, k: tuple) -> Callable:
    names: dict[str, Any] = {"times": made.transposed_multiplier(*c, shape[0]), "mirror": _mirrored(shape, shape)}
    names["less"] = by_entries("{a} - {b}")(p, p, p)
    return written_out("of_best_gain", "p, c, k", "less(p, mirror(times(c, k)))", **names)


def _with_transposed(shape: tuple, *of: tuple) -> Callable:
    return entrywise("total", "a", shape, lambda i, j: f"a[{i}][{j}] + a[{j}][{i}]", a=shape)


def _identity(shape: tuple, *of: tuple) -> Callable:
    source = Source("identity", "", result=shape)
    return source.function(source.entries(shape, lambda i, j: source.if_same(i, j, "1.0", "0.0")))


def _on_one_branch(shape: tuple, angles: tuple[bool, ...], *of: tuple) -> Callable:
    source = Source("wrapped_angles", "a", result=shape, a=shape)

    def entry(i, *others) -> str:
        return short_way(f"a[{i}]" + "".join(f"[{j}]" for j in others), i, angles)

    return source.function(source.entries(shape, entry), **NAMES)


def _only(result: tuple, z: tuple, shape: tuple) -> Callable:
    def entry(i, *others) -> str:
        return f"(a[{i}]" + "".join(f"[{j}]" for j in others) + f" if z[{i}] == z[{i}] else 0.0)"

    return entrywise("only", "z, a", shape, entry, z=z, a=shape)


def _uncorrelated(result: tuple, z: tuple, shape: tuple) -> Callable:
    return written_out("uncorrelated", "z, r", "mask(r, z)", mask=made.masked(*z))


def _quotient(result: tuple, c: tuple, of: tuple) -> Callable:
    return made.vector_solver(*c) if len(c) == 1 else made.row_solver(*c)


def _inverse(result: tuple, of: tuple, z: tuple) -> Callable:
    source = Source("known", "s, z", result=of, s=of, z=z)
    missing = "(s[{0}][{0}] if z[{0}] == z[{0}] else 0.0)"
    entries = source.entries(of, lambda i, j: source.if_same(i, j, missing.format(i), f"s[{i}][{j}]"))
    names: dict[str, Any] = {"known": source.function(entries), "invert": made.factored_inverse(of[0])}
    return written_out("inverse", "l, z", "known(invert(l), z)", **names)


def _dot(result: tuple, a: tuple, b: tuple) -> Callable:
    source = Source("dot", "a, b", a=a, b=b)
    return source.function(source.sum(f"a[{i}] * b[{i}]" for i in source.range(*a)))


def _stretch(result: tuple, w: tuple, other: tuple, e: tuple, ds: tuple) -> Callable:
    source = Source("stretch", "w, o, e, ds", work=prod(e), w=w, o=other, e=e, ds=ds)
    rows = source.range(*w)
    terms = (f"(w[{i}] * o[{j}] - e[{i}][{j}]) * ds[{i}][{j}]" for i in rows for j in source.range(*w))
    return source.function(f"0.5 * ({source.sum(terms)})")


def _of_tail(text: str) -> Callable:
    def make(result: tuple, q: tuple, z: tuple, tail: tuple) -> Callable:
        source = Source("of_tail", "q, z, tail", z=z, tail=tail)
        source.line("d = " + source.sum(f"(1 if z[{i}] == z[{i}] else 0)" for i in source.range(*z)))
        return source.function(text, log=np.log)

    return make


HEAVIER = "tail[1 + int(d)] + 0.5 * q - 0.5 * (1.0 / tail[0] + d) * log(1.0 + tail[0] * q / (1.0 - 2.0 * tail[0]))"
WEIGHT = "(1.0 + tail[0] * d) / (1.0 - 2.0 * tail[0] + tail[0] * q)"

_FUNCTIONS: dict[Operation, Callable] = {
    matrices.scale: _multiple,
    matrices.transposed: lambda result, shape: made.transposer(*shape),
    operations.mirrored: _mirrored,
    operations.with_transposed: _with_transposed,
    operations.congruence: _congruence,
    operations.of_best_gain: _of_best_gain,
    operations.eye: _identity,
    operations.on_one_branch: _on_one_branch,
    operations.only: _only,
    operations.uncorrelated: _uncorrelated,
    operations.factor: lambda result, shape: made.cholesky_factor(shape[0]),
    operations.quotient: _quotient,
    operations.inverse: _inverse,
    densities.density: lambda result, v, of, z: made.innovation_likelihood(*v),
    densities.dot: _dot,
    densities.stretch: _stretch,
    densities.heavier: _of_tail(f"({HEAVIER} if tail[0] > 0.0 else 0.0)"),
    densities.outlier_weight: _of_tail(WEIGHT),
    **points_called.FUNCTIONS,
    **blocks_called.FUNCTIONS,
    **members_called.FUNCTIONS,
    **geometric.FUNCTIONS,
    **upper_called.FUNCTIONS,
}
