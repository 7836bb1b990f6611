"""Rendering, common to all envs of plants."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import at_least, short_repr

if TYPE_CHECKING:
    from thruster_env.render.renderer import PlantRenderer


SMALLEST, LARGEST = 64, 4096  # side of a picture [px]


def checked_size(size: Sequence[int] | None) -> tuple[int, int] | None:
    """A size of pictures, (width, height) [px], as a pair of integers, or None; ValueError for any other."""
    if size is None:
        return None
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise ValueError(f"render_size must be None or (width, height) in pixels, but got {short_repr(size)}")
    width, height = (
        at_least(f"the {side} of render_size", value, SMALLEST, LARGEST)
        for side, value in zip(("width", "height"), size, strict=True)
    )
    return width, height


class RenderedEnv(gym.Env):
    """An env with a `plant` that can draw itself, in the modes of its `metadata`.

    A plant's env defines `make_renderer`, which returns its renderer, and `moment_of`, the renderer's input from a
    step's report.
    """

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 100}
    render_overlay: Callable[[], Any] | None = None  # a filter wrapper's hook: what it shows beside the truth

    plant: Any
    _renderer: PlantRenderer | None = None

    def make_renderer(self) -> PlantRenderer:
        """The renderer of this env for its `render_mode`."""
        raise NotImplementedError

    def moment_of(self, report: list[float]) -> tuple:
        """The renderer's input from a report."""
        raise NotImplementedError

    def _prepare_rendering(self, render_mode: str | None, render_size: Sequence[int] | None = None) -> None:
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            rule = " or ".join(["None", *map(repr, modes)])
            raise ValueError(f"render_mode must be {rule}, but got {render_mode!r}")
        self.render_mode, self.render_size = render_mode, checked_size(render_size)
        self._renderer = None
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / self.plant.dt))}  # true speed

    def render(self) -> np.ndarray | None:
        """Draw the plant: an array (height, width, 3) of uint8 in mode "rgb_array", a window in mode "human"."""
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

    def _show(self, report: list[float], *, begin: bool = False) -> None:
        """Note what a reset (`begin`) or a step reported, and draw it in a window."""
        if self._renderer is None:
            self._renderer = self.make_renderer()
        if begin:
            self._renderer.begin()
        elif self.render_overlay is not None:
            self._renderer.amend(self.render_overlay())  # of the moment before: the wrapper updates after the step
        self._renderer.add(self.moment_of(report))
        if self.render_mode == "human":
            self._renderer.draw()
