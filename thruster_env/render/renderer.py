"""Renderer of an episode of a plant: it keeps the last steps, and shows them as arrays or in a window."""

from __future__ import annotations

import os
from typing import Any, ClassVar

import numpy as np
from gymnasium.error import DependencyNotInstalled

from thruster_env.core.checks import one_of, positive
from thruster_env.core.extras import to_install
from thruster_env.render.history import History

MODES = ("human", "rgb_array")


class PlantRenderer:
    """Draws an episode: `begin` it, `add` every moment from the reset's on, `draw` where a frame is wanted.

    A plant's class calls `_set_up` with its own arguments, makes its pictures in `_make_pictures` and draws them
    in `_draw`. pygame is imported with the first renderer.

    Attributes:
        caption: of the window.
        remembered: names of attributes that a copy keeps, beside the history.
    """

    caption: ClassVar[str]
    remembered: ClassVar[tuple[str, ...]] = ()

    def _set_up(self, made_with: dict[str, Any], moment: tuple[str, ...], overlay: tuple[str, ...]) -> None:
        """Load pygame and draw what never moves.

        Args:
            made_with: arguments of `__init__` by name; `mode` is "human" (a window) or "rgb_array" (arrays),
                `frames_per_second` how many calls of `draw` a second a window keeps to [1/s], `size` that of the
                picture [px], 640 x 400 if None.
            moment: names of a moment's entries.
            overlay: names of an overlay's, behind its label.

        Raises:
            ValueError: for a mode that is not one of the two, or a number that is not positive.
            DependencyNotInstalled: if pygame is missing.
        """
        self._made_with = made_with
        self.mode = one_of("mode", made_with["mode"], MODES)
        frame_time = 1.0 / positive("frames_per_second", made_with["frames_per_second"])
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it would greet on standard output
        try:
            import pygame  # noqa: F401
        except ImportError as error:
            raise DependencyNotInstalled(
                f"rendering needs pygame, which is not installed: {to_install('render')}"
            ) from error
        from thruster_env.render.canvas import SIZE, Canvas
        from thruster_env.render.window import Window

        size = made_with.get("size") or SIZE
        self._canvas = Canvas(size)
        self._make_pictures()
        self._canvas.keep()
        self._window = Window(frame_time, self.caption, size) if self.mode == "human" else None
        self._history = History(moment, overlay)
        self.begin()

    def _make_pictures(self) -> None:
        """Make what draws the parts of the picture on `_canvas`, what never moves included."""
        raise NotImplementedError

    def _draw(self, columns: dict[str, np.ndarray], count: int, label: str) -> None:
        """Draw the columns of the history; `count` moments were added, `label` names the filter."""
        raise NotImplementedError

    def __getstate__(self) -> tuple[dict, dict]:
        """Its arguments and what it remembers; pygame's surfaces cannot be copied."""
        return self._made_with, {name: getattr(self, name) for name in ("_history", *self.remembered)}

    def __setstate__(self, state: tuple[dict, dict]) -> None:
        """Redraw the pictures from the history."""
        made_with, remembered = state
        type(self).__init__(self, **made_with)
        vars(self).update(remembered)

    def begin(self) -> None:
        """Start an episode: nothing is remembered."""
        self._history.clear()

    def add(self, moment: Any, overlay: Any = None) -> None:
        """Note a moment, a sample time after the one before; the first of an episode is that of the reset."""
        self._history.add(moment)
        self.amend(overlay)

    def amend(self, overlay: tuple | None) -> None:
        """Add what a filter believes of the moment noted last."""
        if overlay is not None and self._history.count:
            self._history.amend(overlay)

    def draw(self) -> np.ndarray | None:
        """Draw the newest moment; drawn twice, it gives the same picture.

        Returns:
            The picture, (height, width, 3) of uint8, in the mode "rgb_array"; None in the mode "human", which
            shows it in a window and waits for its time.

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
        self._draw(self._history.columns(), self._history.count, self._history.label)
        return self._canvas.finish()
