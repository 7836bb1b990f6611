"""Formulas of matrices, written as in a textbook: "F P F' + Q". Small, they are compiled as scalar code."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from typing import Any

from numerics.matrices import multiplier, transposed_multiplier, transposer, vector_multiplier
from numerics.sources import LONGEST_TEXT, Source, is_array, matrix_of, tuple_of, written_out


@cache
def formula(text: str, **shapes: tuple[int, ...]) -> Callable:
    """Return the function of a sum of products; its arguments are named and ordered as in `shapes`.

    Args:
        text: products of names, separated by spaces, with + and - between them; a ' behind a name transposes.
        shapes: of each name, (rows, columns) for a matrix, or (rows,) for a vector.

    Returns:
        A function that returns a matrix, or a vector if all products end with vectors. They are tuples where they
        are small and arrays where they are not, as `numerics.sources.is_array` says.

    Raises:
        ValueError: if a name has no shape, or shapes do not fit.

    Example:
        predict = formula("F P F' + Q", F=(2, 2), P=(2, 2), Q=(2, 2))
    """
    products = re.findall(r"([+-]?)\s*([^+-]+)", text)
    if any(is_array(*shape) for shape in shapes.values()) or _longest(products, shapes) > LONGEST_TEXT:
        return _product_by_product(text, products, shapes)
    lines: list[str] = []
    entries: list[list[str]] = []  # of all products, by rows
    sizes = set()
    for place, (sign, product) in enumerate(products):
        names = product.split()
        value, size = _factor(names[0], shapes)
        for number, name in enumerate(names[1:]):
            other, (inner, columns) = _factor(name, shapes)
            if inner != size[1]:
                raise ValueError(f"shapes must fit in {product.strip()!r}, but got {shapes}")
            sources = [
                [" + ".join(f"{value[i][q]} * {other[q][j]}" for q in range(inner)) for j in range(columns)]
                for i in range(size[0])
            ]
            value = [[f"p{place}_{number}_{i}_{j}" for j in range(columns)] for i in range(size[0])]
            lines += [f"{value[i][j]} = {sources[i][j]}" for i in range(size[0]) for j in range(columns)]
            size = size[0], columns
        sizes.add((*size, len(shapes[names[-1].rstrip("'")])))
        entries.append([f"{sign or '+'} {entry}" for row in value for entry in row])
    rows, columns, dimensions = _only(sizes, text, shapes)
    sums = [" ".join(parts) for parts in zip(*entries, strict=True)]
    result = tuple_of(sums) if dimensions == 1 else matrix_of(rows, columns, lambda i, j: sums[i * columns + j])
    return written_out("formula", ", ".join(shapes), *lines, result)


def _only(sizes: set, text: str, shapes: dict):
    if len(sizes) != 1:
        raise ValueError(f"the products of {text!r} must have one shape, but got {shapes}")
    return sizes.pop()


def _longest(products: list[tuple[str, str]], shapes: dict) -> int:
    """How many products of numbers the longest product of two matrices has."""
    longest = 0
    for _, product in products:
        sizes = [_size(name, shapes) for name in product.split()]
        longest = max([longest, *(sizes[0][0] * inner * columns for inner, columns in sizes[1:])])
    return longest


def _size(name: str, shapes: dict) -> tuple[int, int]:
    """Rows and columns of one factor."""
    plain = name.rstrip("'")
    if plain not in shapes:
        raise ValueError(f"every name must have a shape, but {plain!r} has none")
    size = (*shapes[plain], 1)[:2]
    return size[::-1] if name != plain else size


def _product_by_product(text: str, products: list[tuple[str, str]], shapes: dict) -> Callable:
    """The same formula as calls of functions of two matrices."""
    lines: list[str] = []
    names: list[str] = []
    parts: dict[str, Any] = {}
    made: set[tuple[int, int, int]] = set()

    def call(function: Callable, *arguments: str) -> str:
        parts[f"f{len(parts)}"] = function
        lines.append(f"v{len(parts)} = f{len(parts) - 1}({', '.join(arguments)})")
        return f"v{len(parts)}"

    for _, product in products:
        first, *others = product.split()
        value, size = first.rstrip("'"), _size(first, shapes)
        if value != first:
            value = call(transposer(*size[::-1]), value)
        for name in others:
            other, plain = _size(name, shapes), name.rstrip("'")
            if other[0] != size[1]:
                raise ValueError(f"shapes must fit in {product.strip()!r}, but got {shapes}")
            if len(shapes[plain]) == 1:
                value = call(vector_multiplier(*size), value, plain)
            else:
                maker = multiplier if name == plain else transposed_multiplier
                value = call(maker(*size, other[1]), value, plain)
            size = size[0], other[1]
        names.append(value)
        made.add((*size, len(shapes[product.split()[-1].rstrip("'")])))
    rows, columns, dimensions = _only(made, text, shapes)
    shape = (rows, columns)[:dimensions]
    terms = [f"a{place}" for place in range(len(names))]
    of_terms: dict[str, Any] = dict.fromkeys(terms, shape)
    source = Source("total", ", ".join(terms), result=shape, **of_terms)
    signs = [sign or "+" for sign, _ in products]

    def entry(*place):
        at = "".join(f"[{i}]" for i in place)
        return " ".join(f"{sign} {term}{at}" for sign, term in zip(signs, terms, strict=True))

    total = source.function(source.entries(shape, entry))
    result = f"total({', '.join(names)})"
    return written_out("formula", ", ".join(shapes), *lines, result, total=total, _loops=True, **parts)


def _factor(name: str, shapes: dict) -> tuple[list[list[str]], tuple[int, int]]:
    """Sources of the entries of one factor, and its size."""
    plain = name.rstrip("'")
    if plain not in shapes:
        raise ValueError(f"every name must have a shape, but {plain!r} has none")
    if len(shapes[plain]) == 1:
        rows = shapes[plain][0]
        return [[f"{plain}[{i}]"] for i in range(rows)], (rows, 1)
    rows, columns = shapes[plain]
    if name != plain:
        return [[f"{plain}[{j}][{i}]" for j in range(rows)] for i in range(columns)], (columns, rows)
    return [[f"{plain}[{i}][{j}]" for j in range(columns)] for i in range(rows)], (rows, columns)
