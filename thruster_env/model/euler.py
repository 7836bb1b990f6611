"""States that turn, for people: rotations by roll, pitch and yaw, directions by two angles, in degrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thruster_env.core.angles import wrapped_where
from thruster_env.model import rotations
from thruster_env.model.quantities import Output, Quantity
from thruster_env.model.turns import Turn, move, parts_of, tangent_flags

EULER = "roll", "pitch", "yaw"
SMALL_STEP = 1e-6  # of a tangent, for slopes


@dataclass(frozen=True)
class EulerAngle:
    """The output of a state that is roll, pitch or yaw [rad] of a rotation, as `rotations.euler` has them."""

    stored: int
    axis: int

    def __call__(self, x: Any, c: Any) -> Any:
        """The angle of a state x."""
        return rotations.euler(x[self.stored : self.stored + 4])[self.axis]


def euler_outputs(turns: Sequence[Turn], states: Sequence[Quantity]) -> dict[str, Output]:
    """Roll, pitch and yaw of each rotation and pose; of several the quaternion's symbol stands before them."""
    attitudes, outputs = [turn for turn in turns if turn.kind != "direction"], {}
    for turn in attitudes:
        start = f"{states[turn.stored].symbol.rpartition('_')[0]}_" if len(attitudes) > 1 else ""
        for index, name in enumerate(EULER):
            quantity = Quantity(f"{start}{name}", f"{start}{name}", "rad", True)
            outputs[quantity.symbol] = Output(quantity, EulerAngle(turn.stored, index))
    return {symbol: output for symbol, output in outputs.items() if symbol not in {s.symbol for s in states}}


def displayed_quantities(states: Sequence[Quantity], turns: Sequence[Turn]) -> list[Quantity]:
    """The quantities (t) of `displayed`: roll, pitch, yaw [deg] of a rotation, two angles of a direction."""
    result = list(states)
    for turn in reversed(turns):
        symbol = states[turn.stored].symbol.rpartition("_")[0]
        names = ("azimuth", "elevation") if turn.kind == "direction" else EULER
        angles_ = [Quantity(f"{turn.name} {name}", f"{symbol}_{name}", "deg") for name in names]
        unit_numbers = turn.quaternion.stop - turn.quaternion.start
        result[turn.stored : turn.stored + unit_numbers] = angles_
    return result


def displayed(x: Any, turns: Sequence[Turn]) -> list:
    """The state x (n) as t numbers for people: rotations by roll, pitch, yaw [deg], directions by two."""
    result: list[Any] = []
    for turn, i, _ in parts_of(len(x), turns):
        if turn is None:
            result.append(x[i])
        elif turn.kind == "direction":
            a, b, c = turn.of_state(x)
            result += [np.rad2deg(np.arctan2(b, a)), np.rad2deg(np.arctan2(c, np.sqrt(a * a + b * b)))]
        else:
            part = turn.of_state(x)
            result += [*map(np.rad2deg, rotations.euler(part[:4])), *part[4:]]
    return result


def displayed_deviations(means: np.ndarray, covs: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    """Standard deviations (..., t) of `displayed`, to first order, of means (..., n) and covariances."""
    x, columns = np.moveaxis(means, -1, 0), []
    for unit_ in SMALL_STEP * np.eye(covs.shape[-1]):
        ends = [np.stack(displayed(move(x, sign * unit_, turns), turns), axis=-1) for sign in (1.0, -1.0)]
        columns.append(ends[0] - ends[1])
    slopes = np.stack(columns, axis=-1)
    for turn in turns:
        rows = slopes[..., turn.tangent : turn.tangent + min(turn.size, 3), :]
        rows -= 360.0 * np.round(rows / 360.0)
    slopes /= 2.0 * SMALL_STEP
    return np.sqrt(np.maximum(np.einsum("...ij,...jk,...ik->...i", slopes, covs, slopes), 0.0))


def measured_and_predicted(model: Any, z: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measurements (K + 1, channels) and z moved by -v, as numbers for people; of directions no prediction."""
    turns = model.measured_turns
    flags = tangent_flags(model.any_shape.measurement_angles, turns)
    expected = np.stack([np.asarray(part) for part in move(z.T, -v.T, turns)], axis=-1)
    for turn in turns:
        if turn.kind == "direction":  # whose tangents at z and at the prediction have other axes
            expected[:, turn.quaternion] = np.nan
    measured, expected = (np.stack(displayed(rows.T, turns), axis=-1) for rows in (z, expected))
    return wrapped_where(measured, flags), wrapped_where(expected, flags)
