"""What every bow thruster env does about pictures."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from thruster_env.engine.memory import COMMAND, READINGS
from thruster_env.linear.steady_state import state_range
from thruster_env.modelled import ModelledEnv
from thruster_env.rendering.history import Moment, Overlay
from thruster_env.rendering.renderer import MODES, Renderer
from thruster_env.task import thrust_scale


class RenderedEnv(ModelledEnv, gym.Env):
    """An env with a `plant` and a `_memory` of one copy that draws itself."""

    metadata: dict[str, Any] = {"render_modes": list(MODES), "render_fps": 100}
    render_overlay: Callable[[], Overlay | None] | None = None  # a filter wrapper's hook, see `rendering`

    def _prepare_rendering(self, render_mode: str | None) -> None:
        if render_mode is not None and render_mode not in MODES:
            rule = " or ".join(["None", *map(repr, MODES)])
            raise ValueError(f"render_mode must be {rule}, but got {render_mode!r}")
        self.render_mode = render_mode
        self._renderer: Renderer | None = None
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / self.plant.dt))}  # true speed

    def render(self) -> np.ndarray | None:
        """Draw the thruster: an array (400, 640, 3) of uint8 in mode "rgb_array", a window in mode "human"."""
        if self._renderer is None:
            if self.render_mode is None:
                gym.logger.warn("render() draws nothing without a render_mode, given to gym.make")
            return None
        if self.render_overlay is not None:
            self._renderer.amend(self.render_overlay())
        return self._renderer.draw()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _make_renderer(self) -> Renderer:
        p, top = self.plant.parameters, self.plant.max_voltage
        speed, flow = state_range(p, top) / 2
        return Renderer(
            self.render_mode,
            gear_ratio=p.gear_ratio,
            diameter=p.diameter,
            max_voltage=top,
            thrust_scale=thrust_scale(self.plant),
            speed_scale=speed,
            flow_scale=flow,
            dt=self.plant.dt,
            frames_per_second=self.metadata["render_fps"],
        )

    def _show(self, report: list[float], *, begin: bool = False) -> None:
        """Note what a reset (`begin`) or a step reported, and draw it in a window."""
        if self._renderer is None:
            self._renderer = self._make_renderer()
        if begin:
            self._renderer.begin()
        elif self.render_overlay is not None:
            self._renderer.amend(self.render_overlay())  # of the moment before: the wrapper updates after the step
        omega, flow, thrust, ambient, reference, _, _, time = report[:8]
        channels = self.plant.channels
        measured = report[READINGS + channels.index("thrust")] if "thrust" in channels else math.nan
        voltage = float(self._memory[0, COMMAND, 0])
        self._renderer.add(Moment(time, omega, flow, thrust, measured, reference, voltage, ambient))
        if self.render_mode == "human":
            self._renderer.draw()
