"""How a bow thruster env draws itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from thruster_env.core.memory import TIME
from thruster_env.env.rendered import RenderedEnv
from thruster_env.thruster.engine.memory import AMBIENT, COMMAND, FLOW, OMEGA, READINGS, REFERENCE, THRUST
from thruster_env.thruster.linear.steady_state import state_range
from thruster_env.thruster.plant import Plant
from thruster_env.thruster.rendering.history import Moment
from thruster_env.thruster.rendering.renderer import MODES, Renderer
from thruster_env.thruster.task import thrust_scale


def renderer_of(
    plant: Plant, mode: str, frames_per_second: float, size: tuple[int, int] | None = None
) -> Renderer:
    """What draws a plant, its scales those of the full voltage; arguments are those of `Renderer`."""
    p, top = plant.parameters, plant.max_voltage
    speed, flow = state_range(p, top) / 2
    return Renderer(
        mode,
        gear_ratio=p.gear_ratio,
        diameter=p.diameter,
        max_voltage=top,
        thrust_scale=thrust_scale(plant),
        speed_scale=speed,
        flow_scale=flow,
        dt=plant.dt,
        frames_per_second=frames_per_second,
        size=size,
    )


class RenderedThruster(RenderedEnv):
    """An env with a thruster as `plant`, and a `_memory` of one copy."""

    _memory: np.ndarray
    metadata: dict[str, Any] = {"render_modes": list(MODES), "render_fps": 100}

    def make_renderer(self) -> Renderer:
        """What draws the thruster in its water."""
        assert self.render_mode is not None  # a renderer is made for a mode only
        return renderer_of(self.plant, self.render_mode, self.metadata["render_fps"], self.render_size)

    def moment_of(self, report: list[float]) -> Moment:
        """What the renderer adds of a report: truth, measured thrust, reference and voltage."""
        channels = self.plant.channels
        measured = report[READINGS + channels.index("thrust")] if "thrust" in channels else math.nan
        return Moment(
            time=report[TIME],
            omega_m=report[OMEGA],
            U_a=report[FLOW],
            thrust=report[THRUST],
            measured_thrust=measured,
            reference=report[REFERENCE],
            voltage=float(self._memory[0, COMMAND, 0]),
            ambient_velocity=report[AMBIENT],
        )
