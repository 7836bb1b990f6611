"""A short hash that identifies a model: its quantities, and its functions' values at fixed points."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from thruster_env.core.sources import as_value

if TYPE_CHECKING:
    from thruster_env.model.state_space import StateSpaceModel

LENGTH = 12  # hexadecimal digits
MAGNITUDES = (0.0, 0.1, 1.0, 1.0, 10.0, 100.0)  # of states and inputs at the points
DIGITS = 10  # of a value: further ones differ from one machine to another
SMALL = 1e-2  # of the largest number at a point: of less, less digits are sure, as it may be a difference


def digest_of(model: StateSpaceModel) -> str:
    """A hash of names, units, sizes and substeps, and of the values of f and h at fixed points.

    The hash omits noise and prior, which tuning changes, Jacobians, which follow from the functions, and
    operating points and ranges, which only help a filter. The points are the same for all models of a size: points
    about the prior would change with it. Values are rounded to ten digits, so that other machines and versions of
    Python compute the same hash.
    """
    constants = getattr(model.constants, "_fields", len(model.constants))
    parts = {
        "quantities": model.quantities,
        "outputs": {symbol: output.quantity for symbol, output in model.outputs.items()},
        "sizes": (model.n, model.inputs, model.m, model.substeps),
        "constants": constants,
        "transition": _values(model.transition, model, (model.n, model.inputs)),
        "observe": _values(model.observe, model, (model.n,)),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:LENGTH]


def _points(sizes: tuple[int, ...]) -> list[list[tuple[float, ...]]]:
    """Vectors of the sizes for each point, of which every other one has positive components only."""
    points = []
    for k, magnitude in enumerate(MAGNITUDES):
        signs = (1.0, -1.0) if k % 2 else (1.0, 1.0)
        points.append(
            [
                tuple(magnitude * signs[(i + j) % 2] * (1.0 + ((3 * i + 5 * k + j) % 7) / 7) for i in range(size))
                for j, size in enumerate(sizes)
            ]
        )
    return points


def _values(function: Callable, model: StateSpaceModel, sizes: tuple[int, ...]) -> list:
    """What a function returns at the points, in digits, or what it raises."""
    found: list = []
    for point in _points(sizes):
        try:
            with np.errstate(all="ignore"):
                values = [float(value) for value in function(*map(as_value, point), model.given_constants)]
        except Exception as error:  # a point where the model is not defined, which is a trait of it, too
            found.append(type(error).__name__)
            continue
        numbers = [*values, *(x for vector in point for x in vector)]
        largest = max((abs(number) for number in numbers if math.isfinite(number)), default=0.0)
        found.append([_rounded(value, largest) for value in values])
    return found


def _rounded(value: float, largest: float) -> str:
    if not math.isfinite(value):
        return str(value)
    if abs(value) >= SMALL * largest > 0.0:
        return f"{value:.{DIGITS - 1}e}"
    return str(round(value / largest * 10**DIGITS / SMALL)) if largest > 0.0 else "0"
