"""Formulas of small matrices, written as in a textbook and compiled as scalar code: "F P F' + Q"."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

from numerics.tuples import matrix_of, tuple_of, written_out


@cache
def formula(text: str, **shapes: tuple[int, ...]) -> Callable:
    """Return the function of a sum of products; its arguments are named and ordered as in `shapes`.

    Args:
        text: products of names, separated by spaces, with + and - between them; a ' behind a name transposes.
        shapes: of each name, (rows, columns) for a tuple of rows, or (rows,) for a vector, a tuple of components.

    Returns:
        A function that returns a tuple of rows, or of components if all products end with vectors.

    Raises:
        ValueError: if a name has no shape, or shapes do not fit.

    Example:
        predict = formula("F P F' + Q", F=(2, 2), P=(2, 2), Q=(2, 2))
    """
    lines: list[str] = []
    entries: list[list[str]] = []  # of all products, by rows
    sizes = set()
    for place, (sign, product) in enumerate(re.findall(r"([+-]?)\s*([^+-]+)", text)):
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
    if len(sizes) != 1:
        raise ValueError(f"the products of {text!r} must have one shape, but got {shapes}")
    rows, columns, dimensions = sizes.pop()
    sums = [" ".join(parts) for parts in zip(*entries, strict=True)]
    result = tuple_of(sums) if dimensions == 1 else matrix_of(rows, columns, lambda i, j: sums[i * columns + j])
    return written_out("formula", ", ".join(shapes), *lines, result)


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
