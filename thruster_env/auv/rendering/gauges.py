"""Right of path and charts: the attitude on three dials, and the action of propeller and planes."""

from __future__ import annotations

import math

import numpy as np

from thruster_env.auv.rendering.history import Moment
from thruster_env.auv.rendering.view import FIN, HULL, OUTLINE
from thruster_env.render.axis import Axis
from thruster_env.render.canvas import ESTIMATE, FAINT, INK, PANEL, SIZE, SOFT_INK, WHITE, Canvas, number
from thruster_env.render.history import newest

LEFT = 498  # of the dials' panel [px]
DIAL, RADIUS = 548, 27  # their middle and radius [px]
TOP, HEIGHT = 258, 104  # of the gauges [px]
THRUST, STERN, RUDDER = 528, 572, 616  # their middle [px]


class Dials:
    """Pitch seen from port, roll seen from astern, yaw seen from above; the estimate is a line across the dial."""

    def __init__(self, canvas: Canvas, bottom: float):
        """Draw what never moves, down to a height of the picture [px]."""
        self._canvas = canvas
        canvas.box(LEFT, 0, SIZE[0] - LEFT, bottom, PANEL)
        canvas.box(LEFT, 0, 1, bottom, (186, 200, 210))
        self._middles = [bottom * (2 * k + 1) / 6 for k in range(3)]
        for y in self._middles:
            canvas.disc((DIAL, y), RADIUS + 1.5, (196, 206, 214))
            canvas.disc((DIAL, y), RADIUS, WHITE)
        for y in self._middles[:2]:
            canvas.box(DIAL - RADIUS, y - 0.4, 2 * RADIUS, 0.8, FAINT)

    def draw(self, columns: dict[str, np.ndarray], moment: Moment) -> None:
        """Draw the newest attitude."""
        pitch, roll, yaw = self._middles
        # Directions of the nose in the picture: from port it points left, so that pitching up turns it clockwise.
        self._hull((DIAL, pitch), math.pi + moment.theta)
        self._tail((DIAL, roll), moment.phi)
        self._hull((DIAL, yaw), moment.psi - math.pi / 2)
        for y, name, value, turn in (
            (pitch, "theta", moment.theta, math.pi),
            (roll, "phi", moment.phi, 0.0),
            (yaw, "psi", moment.psi, -math.pi / 2),
        ):
            estimate = newest(columns, f"estimated_{name}")
            if math.isfinite(estimate):
                self._line((DIAL, y), turn + estimate)
            self._write(y, name, value, estimate)
        self._canvas.text("N", (DIAL, yaw - RADIUS + 6), 9, SOFT_INK, 0.5)

    def _write(self, y: float, name: str, value: float, estimate: float) -> None:
        title = {"theta": "pitch", "phi": "roll", "psi": "yaw"}[name]
        write, x = self._canvas.text, DIAL + RADIUS + 7
        write(title, (x, y - 14), 11, INK)
        write(number(_degrees(value), 1) + "\u00b0", (x, y + 1), 11, INK)
        if math.isfinite(estimate):
            write(number(_degrees(estimate), 1) + "\u00b0", (x, y + 15), 11, ESTIMATE)

    def _hull(self, middle, angle: float) -> None:
        if not math.isfinite(angle):
            return
        ahead = np.array([math.cos(angle), math.sin(angle)]) * 1.55 * RADIUS
        across = np.array([-ahead[1], ahead[0]])
        along, radius = OUTLINE[:, :1], OUTLINE[:, 1:]
        centre = np.array(middle)
        for side in (-0.17, 0.17):
            self._canvas.lines([centre - 0.42 * ahead, centre - 0.46 * ahead + side * across], FIN, 2.5)
        outline = np.concatenate([along * ahead + radius * across, (along * ahead - radius * across)[::-1]])
        self._canvas.polygon(centre + outline, HULL)

    def _tail(self, middle, phi: float) -> None:
        if not math.isfinite(phi):
            return
        centre = np.array(middle)
        for turn in (phi, phi + math.pi / 2):
            arm = 0.72 * RADIUS * np.array([math.cos(turn), math.sin(turn)])
            self._canvas.lines([centre - arm, centre + arm], FIN, 2.5)
        self._canvas.disc(middle, 0.42 * RADIUS, HULL)

    def _line(self, middle, angle: float) -> None:
        arm = RADIUS * np.array([math.cos(angle), math.sin(angle)])
        self._canvas.lines([np.array(middle) + 0.75 * arm, np.array(middle) + 1.1 * arm], ESTIMATE, 3)


class Gauges:
    """Thrust and both planes as bars from zero."""

    def __init__(self, canvas: Canvas, max_thrust: float, max_plane: float):
        """Draw what never moves; full scales are max_thrust [N] and max_plane [rad]."""
        self._canvas = canvas
        top = max(math.degrees(max_plane), 1e-3)
        self._axes = {
            THRUST: Axis(0.0, max_thrust, TOP, HEIGHT),
            STERN: Axis(-top, top, TOP, HEIGHT),
            RUDDER: Axis(-top, top, TOP, HEIGHT),
        }
        for middle in self._axes:
            canvas.box(middle - 7, TOP - 2, 14, HEIGHT + 4, WHITE, 3)
            canvas.box(middle - 7, TOP - 2, 14, HEIGHT + 4, (196, 206, 214), 3, 1)

    def draw(self, moment: Moment) -> None:
        """Draw what acts at a moment."""
        values = {THRUST: moment.thrust, STERN: math.degrees(moment.stern), RUDDER: math.degrees(moment.rudder)}
        for (x, axis), title in zip(self._axes.items(), ("thrust", "stern", "rudder"), strict=True):
            canvas, value, zero = self._canvas, values[x], axis.y(0.0)
            if math.isfinite(value):
                y = min(max(axis.y(value), TOP), TOP + HEIGHT)
                canvas.box(x - 5, min(y, zero), 10, abs(y - zero), (158, 172, 185))
                canvas.box(x - 9, y - 1.25, 18, 2.5, INK)
            canvas.box(x - 7, zero - 0.4, 14, 0.8, SOFT_INK)
            canvas.text(title, (x, TOP - 13), 11, INK, 0.5)
            text = number(value, 2) + " N" if x == THRUST else number(value, 1) + "\u00b0"
            canvas.text(text, (x, TOP + HEIGHT + 14), 11, INK, 0.5)


def _degrees(angle: float) -> float:
    """An angle in degrees within half a turn."""
    return math.degrees(math.remainder(angle, 2.0 * math.pi)) if math.isfinite(angle) else math.nan
