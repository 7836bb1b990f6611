"""Axes and units of an inertial sensor's log: gravity and the field turn against the gyroscope, or it is off.

A vector of the world, s in the axes of the body, changes with the angle a of a short turn by

    s_1 - s_0 = (s_0 + s_1)/2 x a

whatever the attitude is. With s x (k P a), of a scale k and a permutation P of axes with signs, the correlation is
largest where the sensors have the same axes and unit: P = 1 and k = 1.
"""

from __future__ import annotations

from itertools import permutations, product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from thruster_env.logs.log import Log

AXES = "xyz"
WINDOW = 0.1  # s, of a turn
FEWEST = 50  # turns
LATEST = 1.0  # s, of a first sample
CORRELATED, HIGHER = 0.6, 0.15  # the best correlation, at least, and how much it must be above that of P = 1
LEAST_SCALE, MOST_SCALE = 0.3, 3.0  # an accelerometer far from the axis of swinging turns faster, too
GRAVITY, LEAST_GRAVITY, MOST_GRAVITY = 9.81, 7.0, 13.0  # m/s^2
UNITS = {"deg/s": 0.0174533, "rpm": 0.104720, "mrad/s": 1e-3}  # in rad/s
SENSORS = {"acc": "accelerometer", "mag": "magnetometer"}


class Fit(NamedTuple):
    """How a vector turns against the gyroscope."""

    axes: tuple[str, ...]  # of the gyroscope, such as ("y", "x", "-z"), that stand for its x, y and z
    scale: float  # k
    correlation: float
    as_named: float  # the correlation with P = 1

    @property
    def is_off(self) -> bool:
        """Whether axes or unit differ, without a doubt."""
        if self.correlation < CORRELATED:
            return False
        is_swapped = self.axes != tuple(AXES) and self.correlation > self.as_named + HIGHER
        return is_swapped or not LEAST_SCALE < self.scale < MOST_SCALE

    def agrees(self, other: Fit) -> bool:
        """Whether another vector has the same axes, and about the same scale."""
        return self.axes == other.axes and 0.7 < self.scale / other.scale < 1.4

    @property
    def inverse(self) -> tuple[str, ...]:
        """P', the axes of the vector that stand for its x, y and z."""
        axes = {axis[-1]: axis[:-1] + AXES[i] for i, axis in enumerate(self.axes)}
        return tuple(axes[axis] for axis in AXES)

    @property
    def is_proper(self) -> bool:
        """Whether P is a rotation, det P = 1, as it is for each change of the vector's axes, of signs, too."""
        p = [[(-1.0 if axis[0] == "-" else 1.0) * (axis[-1] == other) for other in AXES] for axis in self.axes]
        return bool(np.linalg.det(p) > 0.0)


def of_inertial_sensors(log: Log) -> list[str]:
    """Sentences without a full stop on axes and units that differ; none without gyr_x, gyr_y, gyr_z as inputs."""
    gyroscope = _columns([quantity.symbol for quantity in log.input_quantities], "gyr")
    if gyroscope is None or log.inputs.shape[0] < FEWEST:
        return []
    symbols, sentences, fits = [quantity.symbol for quantity in log.measured], [], {}
    for sensor, name in SENSORS.items():
        columns = _columns(symbols, sensor)
        if columns is None:
            continue
        vectors = log.measurements[:, columns]
        measured = np.isfinite(vectors).all(axis=1)
        if not measured.any():
            continue
        begins = float(log.times[measured.argmax()])
        if begins > LATEST:
            wrong = "attitudes until then are wrong, and those after it for long, beyond their deviations"
            sentences.append(f"The {name} begins after {begins:.3g} s: {wrong}; cut the log to begin there")
        length = float(np.median(np.linalg.norm(vectors[measured], axis=1)))
        if sensor == "acc" and not LEAST_GRAVITY < length < MOST_GRAVITY:
            hint = ": it may be in g; name the unit, as in acc_x [g]" if 0.7 < length < 1.3 else ""
            sentences.append(f"The median of |acc| is {length:.3g} m/s^2, not about {GRAVITY}{hint}")
        fit = fitted(vectors, log.inputs[:, gyroscope], np.diff(log.times))
        if fit is not None and fit.is_off:
            fits[sensor] = fit
    if len(fits) == len(SENSORS) and fits["acc"].agrees(fits["mag"]):
        return [*sentences, _sentence(list(fits), fits["mag"])]
    return sentences + [_sentence([sensor], fit) for sensor, fit in fits.items()]


def fitted(vectors: np.ndarray, rates: np.ndarray, steps: np.ndarray) -> Fit | None:
    """The best axes and scale for vectors (K + 1, 3) and rates (K, 3) [rad/s] over steps (K,) [s]; None if few."""
    stride = max(int(round(WINDOW / float(np.median(steps)))), 1)
    turned = np.vstack([np.zeros(3), np.cumsum(rates * steps[:, None], axis=0)])
    angles = turned[stride:] - turned[:-stride]
    middle, change = (vectors[stride:] + vectors[:-stride]) / 2.0, vectors[stride:] - vectors[:-stride]
    usable = np.isfinite(change).all(axis=1) & np.isfinite(angles).all(axis=1)
    angles, middle, change = angles[usable], middle[usable], change[usable]
    if len(change) < FEWEST or not change.any() or not angles.any():
        return None
    best, as_named = None, 0.0
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        expected = np.cross(middle, angles[:, order] * signs)
        along, power = float(np.sum(expected * change)), float(np.sum(expected**2))
        correlation = along / np.sqrt(power * np.sum(change**2)) if power > 0.0 else 0.0
        axes = tuple(("-" if sign < 0 else "") + AXES[i] for i, sign in zip(order, signs, strict=True))
        if axes == tuple(AXES):
            as_named = correlation
        if best is None or correlation > best[2]:
            best = axes, along / power if power > 0.0 else 0.0, correlation
    assert best is not None
    return Fit(*best, as_named)


def _columns(symbols: list[str], sensor: str) -> list[int] | None:
    """Where a sensor's three axes are; None if one is missing."""
    wanted = [f"{sensor}_{axis}" for axis in AXES]
    return [symbols.index(symbol) for symbol in wanted] if set(wanted) <= set(symbols) else None


def _sentence(sensors: list[str], fit: Fit) -> str:
    are, s = " and ".join(SENSORS[sensor] for sensor in sensors), "" if len(sensors) > 1 else "s"
    if fit.axes != tuple(AXES):
        axes, rest = ", ".join(f"gyr {axis}" for axis in fit.axes), "change the columns of one"
        if len(sensors) == 1 and fit.is_proper:  # as a sensor is, whose axes are changed against the gyroscope's
            axes, rest = ", ".join(f"{sensors[0]} {axis}" for axis in fit.inverse), "or all three of other sign"
        return (
            f"The {are} turn{s} with the gyroscope if x, y, z are ({axes}), correlation {fit.correlation:.2f}, "
            f"and not as named, {fit.as_named:.2f}: {rest}"
        )
    unit = next((unit for unit, size in UNITS.items() if abs(np.log(fit.scale / size)) < 0.3), None)
    hint = f": it may be in {unit}; name the unit, as in gyr_x [{unit}]" if unit else ", in units or times"
    hint += ", or times may be in ms" if unit == "mrad/s" else ""
    return f"The {are} turn{s} {fit.scale:.3g} times as fast as the gyroscope says{hint}"
