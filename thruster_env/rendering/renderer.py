"""The renderer: remembers an episode and draws it; the package says the rest."""

from __future__ import annotations

import os

import numpy as np
from gymnasium.error import DependencyNotInstalled

from numerics.checks import one_of, positive
from thruster_env.rendering.history import ABSURD, History, Moment, Overlay

MODES = ("human", "rgb_array")
# What a renderer keeps of an episode.
REMEMBERED = (
    "_history",
    "_angle",
    "_angle_of_frame",
    "_angle_of_last_frame",
    "_count_of_frame",
    "_omega_m",
)


class Renderer:
    """Draws an episode: `begin` it, `add` every moment from the reset's on, `draw` where a frame is wanted."""

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

        Raises:
            ValueError: for a mode that is not one of the two, or a number that is not positive.
            DependencyNotInstalled: if pygame is missing.
        """
        self._made_with = {
            "mode": mode,
            "gear_ratio": gear_ratio,
            "diameter": diameter,
            "max_voltage": max_voltage,
            "thrust_scale": thrust_scale,
            "speed_scale": speed_scale,
            "flow_scale": flow_scale,
            "dt": dt,
            "frames_per_second": frames_per_second,
        }
        self.mode = one_of("mode", mode, MODES)
        self._dt = positive("dt", dt)
        self._gear_ratio = positive("gear_ratio", gear_ratio)
        frame_time = 1.0 / positive("frames_per_second", frames_per_second)
        thrust_scale, flow_scale = positive("thrust_scale", thrust_scale), positive("flow_scale", flow_scale)
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it would greet on standard output
        try:
            import pygame  # noqa: F401
        except ImportError as error:
            raise DependencyNotInstalled(
                "rendering needs pygame, which is not installed: run `pip install 'thruster-env[render]'`"
            ) from error
        from thruster_env.rendering.canvas import Canvas
        from thruster_env.rendering.charts import Charts
        from thruster_env.rendering.gauges import Gauges
        from thruster_env.rendering.scene import Scene
        from thruster_env.rendering.window import Window

        self._canvas = Canvas()
        self._scene = Scene(
            self._canvas,
            diameter=positive("diameter", diameter),
            gear_ratio=self._gear_ratio,
            thrust_scale=thrust_scale,
            flow_scale=flow_scale,
        )
        self._charts = Charts(
            self._canvas,
            dt=self._dt,
            thrust_scale=thrust_scale,
            speed_scale=positive("speed_scale", speed_scale),
            flow_scale=flow_scale,
        )
        self._gauges = Gauges(self._canvas, positive("max_voltage", max_voltage))
        self._canvas.keep()
        self._window = Window(frame_time) if mode == "human" else None
        self._history = History()
        self.begin()

    def __getstate__(self) -> tuple[dict, dict]:
        """Its arguments and what it remembers; pygame's surfaces cannot be copied."""
        return self._made_with, {name: getattr(self, name) for name in REMEMBERED}

    def __setstate__(self, state: tuple[dict, dict]) -> None:
        """Make the pictures anew, for what was remembered."""
        made_with, remembered = state
        self.__init__(**made_with)
        vars(self).update(remembered)

    @property
    def blade_angle(self) -> float:
        """Angle that the propeller has turned since the episode began [rad]."""
        return self._angle

    def begin(self) -> None:
        """Start an episode: the strip charts are empty and a blade points up."""
        self._history.clear()
        self._angle = self._angle_of_frame = self._angle_of_last_frame = 0.0
        self._count_of_frame = 0
        self._omega_m = 0.0

    def add(self, moment: Moment, overlay: Overlay | None = None) -> None:
        """Note a moment, dt after the one before; the first of an episode is that of the reset."""
        omega_m = moment.omega_m if abs(moment.omega_m) < ABSURD else 0.0
        if self._history.count:
            self._angle += 0.5 * (self._omega_m + omega_m) * self._dt / self._gear_ratio
        self._omega_m = omega_m
        self._history.add(moment)
        self.amend(overlay)

    def amend(self, overlay: Overlay | None) -> None:
        """Add what a filter believes of the moment noted last."""
        if overlay is not None and self._history.count:
            self._history.amend(overlay)

    def draw(self) -> np.ndarray | None:
        """Draw the newest moment.

        The propeller is blurred by the angle that it turned since the last frame; drawn twice, a moment gives the
        same picture.

        Returns:
            The picture, (400, 640, 3) of uint8, in the mode "rgb_array"; None in the mode "human", which shows it
            in a window and waits for its time.

        Raises:
            RuntimeError: if no moment has been added since the episode began.
        """
        if not self._history.count:
            raise RuntimeError("there must be a moment to draw: call add after begin")
        if self._window is None:
            return self._canvas.as_array(self._picture())
        self._window.show(self._picture)
        return None

    def close(self) -> None:
        """Close the window, if there is one; the next `draw` opens it again."""
        if self._window is not None:
            self._window.close()

    def _picture(self):
        """The newest moment as a pygame surface, which the next frame overwrites."""
        count = self._history.count
        if count > self._count_of_frame:
            self._count_of_frame = count
            self._angle_of_last_frame, self._angle_of_frame = self._angle_of_frame, self._angle
        columns = self._history.columns()
        moment = Moment(*(float(columns[name][-1]) for name in Moment._fields))
        self._scene.draw(moment, self._angle_of_last_frame, self._angle_of_frame)
        self._gauges.draw(columns, self._charts.draw(columns, count - 1, self._history.label))
        return self._canvas.finish()
