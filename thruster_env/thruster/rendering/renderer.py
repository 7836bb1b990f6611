"""The renderer: remembers an episode and draws it; the package says the rest."""

from __future__ import annotations

from math import isnan
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import positive
from thruster_env.render.canvas import Canvas
from thruster_env.render.charts import ABSURD, Charts, Strip, newest
from thruster_env.render.renderer import MODES, PlantRenderer

# Contents of a picture: the truth at each step, and the estimate of a filter.


class Moment(NamedTuple):
    """The truth at the end of a step, one entry of the strip charts."""

    time: float  # since the start of the episode [s]
    omega_m: float  # motor speed [rad/s]
    U_a: float  # section-average flow velocity [m/s]
    thrust: float  # [N]
    measured_thrust: float  # [N]
    reference: float | None  # thrust to hold [N]
    voltage: float  # [V]
    ambient_velocity: float = 0.0  # U_0 [m/s]


class Overlay(NamedTuple):
    """The estimate of a filter at a step; None where it has none."""

    label: str  # name of the filter in the legend
    thrust: float | None = None  # [N]
    thrust_std: float | None = None  # standard deviation [N]
    omega_m: float | None = None  # [rad/s]
    omega_m_std: float | None = None  # [rad/s]
    U_a: float | None = None  # [m/s]
    U_a_std: float | None = None  # [m/s]


__all__ = ["MODES", "Renderer"]


class Renderer(PlantRenderer):
    """Draws an episode: `begin` it, `add` every moment from the reset's on, `draw` where a frame is wanted."""

    caption = "Bow thruster"
    remembered = ("_angle", "_angle_of_frame", "_angle_of_last_frame", "_count_of_frame", "_omega_m")

    def __init__(
        self,
        mode: str,
        *,
        gear_ratio: float,
        diameter: float,
        max_voltage: float,
        thrust_scale: float,
        speed_scale: float,
        flow_scale: float,
        dt: float,
        frames_per_second: float,
        size: tuple[int, int] | None = None,
    ):
        """Load pygame and draw what never moves.

        Args:
            mode: "human" (a window) or "rgb_array" (arrays).
            gear_ratio: motor speed over propeller speed.
            diameter: of the propeller [m].
            max_voltage: full scale of the voltage gauge [V].
            thrust_scale: thrust at full voltage [N].
            speed_scale: motor speed at full voltage [rad/s].
            flow_scale: flow velocity at full voltage [m/s]; the arrows' lengths are in proportion to it.
            dt: sample time [s].
            frames_per_second: how many calls of `draw` a second a window keeps to [1/s].
            size: of the picture [px]; 640 x 400 if None.

        Raises:
            ValueError: for a mode that is not one of the two, or a number that is not positive.
            DependencyNotInstalled: if pygame is missing.
        """
        arguments = {
            "mode": mode,
            "gear_ratio": gear_ratio,
            "diameter": diameter,
            "max_voltage": max_voltage,
            "thrust_scale": thrust_scale,
            "speed_scale": speed_scale,
            "flow_scale": flow_scale,
            "dt": dt,
            "frames_per_second": frames_per_second,
            "size": size,
        }
        for name, value in arguments.items():
            if name not in ("mode", "size"):
                positive(name, value)
        self._dt, self._gear_ratio = float(dt), float(gear_ratio)
        self._set_up(arguments, Moment._fields, Overlay._fields[1:])

    def _make_pictures(self) -> None:
        from thruster_env.thruster.rendering.scene import Gauges, Scene

        canvas, arguments = self._canvas, self._made_with
        scales = {name: arguments[name] for name in ("thrust_scale", "flow_scale")}
        self._scene = Scene(canvas, diameter=arguments["diameter"], gear_ratio=self._gear_ratio, **scales)
        self._charts = thruster_charts(canvas, dt=self._dt, speed_scale=arguments["speed_scale"], **scales)
        self._gauges = Gauges(canvas, arguments["max_voltage"])

    @property
    def blade_angle(self) -> float:
        """Angle that the propeller has turned since the episode began [rad]."""
        return self._angle

    def begin(self) -> None:
        """Start an episode: the strip charts are empty and a blade points up."""
        super().begin()
        self._angle = self._angle_of_frame = self._angle_of_last_frame = 0.0
        self._count_of_frame = 0
        self._omega_m = 0.0

    def add(self, moment: Moment, overlay: Overlay | None = None) -> None:
        """Note a moment, dt after the one before; the first of an episode is that of the reset.

        Where the truth is not known, NaN, the propeller turns and the water flows as the filter believes.
        """
        omega_m = moment.omega_m
        if isnan(omega_m) and overlay is not None and overlay.omega_m is not None:
            omega_m = overlay.omega_m
        omega_m = omega_m if abs(omega_m) < ABSURD else 0.0
        if self._history.count:
            self._angle += 0.5 * (self._omega_m + omega_m) * self._dt / self._gear_ratio
        self._omega_m = omega_m
        super().add(moment, overlay)

    def _draw(self, columns: dict[str, np.ndarray], count: int, label: str) -> None:
        """Draw the newest moment, the propeller blurred by the angle that it turned since the last frame."""
        if count > self._count_of_frame:
            self._count_of_frame = count
            self._angle_of_last_frame, self._angle_of_frame = self._angle_of_frame, self._angle
        moment = Moment(*(float(columns[name][-1]) for name in Moment._fields))
        believed = {name: newest(columns, f"estimated_{name}") for name in ("omega_m", "U_a", "thrust")}
        moment = moment._replace(**{name: b for name, b in believed.items() if isnan(getattr(moment, name))})
        self._scene.draw(moment, self._angle_of_last_frame, self._angle_of_frame)
        self._gauges.draw(columns, self._charts.draw(columns, count - 1, label)[0])


# The thruster's strip charts: thrust, motor speed and flow.


TOP = 186  # of the lower half of the picture [px]


def thruster_charts(
    canvas: Canvas, *, dt: float, thrust_scale: float, speed_scale: float, flow_scale: float
) -> Charts:
    """Three strip charts; dt is in s, scales are in N, rad/s and m/s. Thrust has a gauge besides."""
    strips = (
        Strip("thrust", "thrust [N]", 1, 207, 66, thrust_scale, "measured_thrust", "reference", False),
        Strip("omega_m", "motor speed [rad/s]", 1, 292, 38, speed_scale),
        Strip("U_a", "flow [m/s]", 2, 349, 34, flow_scale),
    )
    return Charts(canvas, strips, top=TOP, dt=dt)
