"""Gauges of thrust and voltage, right of the strip charts."""

from __future__ import annotations

import math

from thruster_env.render.axis import Axis
from thruster_env.render.canvas import (
    BAND,
    ESTIMATE,
    INK,
    MEASURED,
    REFERENCE,
    SIGMAS,
    SOFT_INK,
    WHITE,
    Canvas,
    number,
    with_band,
)
from thruster_env.render.history import newest

TOP, HEIGHT = 210, 122  # of the gauges [px]
THRUST, VOLTAGE = 538, 612  # their middle [px]
NUMBERS = TOP + HEIGHT + 14  # where the first number below is [px]


class Gauges:
    """Thrust as truth (bar), measurement (dot), estimate (line in its band) and reference (triangle); voltage."""

    def __init__(self, canvas: Canvas, max_voltage: float):
        """Draw what never moves; max_voltage is the gauge's full scale [V]."""
        self._canvas = canvas
        self._voltage_axis = Axis(-max_voltage, max_voltage, TOP, HEIGHT)
        for middle in (THRUST, VOLTAGE):
            canvas.box(middle - 7, TOP - 2, 14, HEIGHT + 4, WHITE, 3)
            canvas.box(middle - 7, TOP - 2, 14, HEIGHT + 4, (196, 206, 214), 3, 1)

    def draw(self, columns, thrust_axis: Axis) -> None:
        """Draw the newest values; the thrust gauge has the ends of the thrust chart."""
        axis = thrust_axis._replace(top=TOP, height=HEIGHT)
        now = {name: float(values[-1]) for name, values in columns.items()}
        thrust, measured = now["thrust"], now["measured_thrust"]
        estimate, std = newest(columns, "estimated_thrust"), newest(columns, "estimated_thrust_std")
        self._draw_truth("thrust", THRUST, axis, thrust)
        self._draw_estimate(axis, estimate, std)
        self._draw_marks(axis, measured, now["reference"])
        numbers = [(number(thrust, 1) + " N", INK), (number(measured, 1) + " N", MEASURED)]
        if math.isfinite(estimate):
            numbers.append((with_band(estimate, std, 1) + " N", ESTIMATE))
        for line, (text, colour) in enumerate(numbers):
            self._canvas.text(text, (THRUST, NUMBERS + 15 * line), 11, colour, 0.5)
        self._draw_truth("voltage", VOLTAGE, self._voltage_axis, now["voltage"])
        self._canvas.text(number(now["voltage"], 1) + " V", (VOLTAGE, NUMBERS), 11, INK, 0.5)

    def _draw_truth(self, title: str, x: float, axis: Axis, value: float) -> None:
        """A bar from zero, with the axis left of it."""
        canvas, zero = self._canvas, axis.y(0.0)
        canvas.text(title, (x, TOP - 13), 11, INK, 0.5)
        if math.isfinite(value):
            y = min(max(axis.y(value), TOP), TOP + HEIGHT)
            canvas.box(x - 5, min(y, zero), 10, abs(y - zero), (158, 172, 185))
            canvas.box(x - 9, y - 1.25, 18, 2.5, INK)
        for tick in {axis.low, axis.low / 2, 0.0, axis.high / 2, axis.high}:
            canvas.box(x - 10, axis.y(tick) - 0.5, 3, 1, SOFT_INK)
        axis.label(canvas, x - 17)

    def _draw_estimate(self, axis: Axis, estimate: float, std: float) -> None:
        x = THRUST + 10
        self._canvas.clip(x, TOP, 13, HEIGHT)
        if math.isfinite(estimate + std):
            high, low = axis.y(estimate + SIGMAS * std), axis.y(estimate - SIGMAS * std)
            self._canvas.box(x + 1, high, 11, max(1.0, low - high), BAND)
        if math.isfinite(estimate):
            self._canvas.box(x, axis.y(estimate) - 1, 13, 2, ESTIMATE)
        self._canvas.clip()

    def _draw_marks(self, axis: Axis, measured: float, reference: float) -> None:
        canvas, x = self._canvas, THRUST
        if math.isfinite(reference):
            y = axis.y(reference)
            canvas.polygon([(x - 16, y - 4.5), (x - 8, y), (x - 16, y + 4.5)], REFERENCE)
        if math.isfinite(measured):
            canvas.disc((x, axis.y(measured)), 4.5, WHITE)
            canvas.disc((x, axis.y(measured)), 3.5, MEASURED)
