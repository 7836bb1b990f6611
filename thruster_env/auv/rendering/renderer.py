"""The renderer: remembers an episode and draws it; the package says the rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import positive
from thruster_env.render.renderer import MODES, PlantRenderer

# The contents of a picture: moments, and a filter's estimates of them.


class Moment(NamedTuple):
    """The truth at the end of a step, one entry of the strip charts."""

    time: float  # since the start of the episode [s]
    x: float  # north [m]
    y: float  # east [m]
    depth: float  # [m]
    phi: float  # [rad]
    theta: float  # [rad]
    psi: float  # [rad]
    u: float  # [m/s]
    measured_depth: float | None  # None where the sensors have none
    measured_u: float | None
    reference_depth: float  # of the path abreast [m]
    reference_u: float  # [m/s]
    thrust: float  # [N]
    stern: float  # [rad]
    rudder: float  # [rad]


class Overlay(NamedTuple):
    """A filter's estimate of a moment; None for states that it does not estimate."""

    label: str  # name of the filter in the legend
    x: float | None = None  # [m]
    x_std: float | None = None
    y: float | None = None
    y_std: float | None = None
    depth: float | None = None
    depth_std: float | None = None
    phi: float | None = None  # [rad]
    theta: float | None = None
    psi: float | None = None
    u: float | None = None  # [m/s]
    u_std: float | None = None


__all__ = ["MODES", "Renderer"]
PANEL = 230  # where the lower part of the picture begins [px]


class Renderer(PlantRenderer):
    """Draws an episode: `begin` it, `add` every moment from the reset's on, `draw` where a frame is wanted."""

    caption = "Underwater vehicle"

    def __init__(
        self,
        mode: str,
        *,
        path: np.ndarray,
        max_thrust: float,
        max_plane: float,
        dt: float,
        frames_per_second: float,
        size: tuple[int, int] | None = None,
    ):
        """Load pygame and draw what never moves.

        Args:
            mode: "human" (a window) or "rgb_array" (arrays).
            path: points (K, 3) of the path to follow: north, east, down [m].
            max_thrust: full scale of the thrust's gauge [N].
            max_plane: full scale of the planes' gauges [rad].
            dt: sample time [s].
            frames_per_second: how many calls of `draw` a second a window keeps to [1/s].
            size: of the picture [px]; 640 x 400 if None.

        Raises:
            ValueError: for a mode that is not one of the two, or a number that is not positive.
            DependencyNotInstalled: if pygame is missing.
        """
        positive("dt", dt)
        positive("max_thrust", max_thrust)
        arguments = {
            "mode": mode,
            "path": path,
            "max_thrust": max_thrust,
            "max_plane": max_plane,
            "dt": dt,
            "frames_per_second": frames_per_second,
            "size": size,
        }
        self._set_up(arguments, Moment._fields, Overlay._fields[1:])

    def _make_pictures(self) -> None:
        from thruster_env.auv.rendering.view import Dials, Gauges, View
        from thruster_env.render.charts import Charts, Strip

        arguments = self._made_with
        strips = (
            Strip("depth", "depth [m]", 2, 254, 54, 100.0, *_named("depth"), says_numbers=False, downward=True),
            Strip("u", "speed ahead [m/s]", 2, 330, 52, 1.0, *_named("u")),
        )
        self._view = View(self._canvas, arguments["path"])
        self._dials = Dials(self._canvas, PANEL)
        self._charts = Charts(self._canvas, strips, top=PANEL, dt=arguments["dt"])
        self._gauges = Gauges(self._canvas, arguments["max_thrust"], arguments["max_plane"])
        self._path = arguments["path"]

    def _draw(self, columns: dict[str, np.ndarray], count: int, label: str) -> None:
        moment = Moment(*(float(columns[name][-1]) for name in Moment._fields))
        offset = moment.reference_depth - float(self._path[0, 2]) if len(self._path) == 2 else 0.0
        self._view.draw(columns, moment, offset)
        self._dials.draw(columns, moment)
        self._charts.draw(columns, count - 1, label)
        self._gauges.draw(moment)


def _named(name: str) -> tuple[str, str]:
    """Columns of a quantity's measurement and reference."""
    return f"measured_{name}", f"reference_{name}"
