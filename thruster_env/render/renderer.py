"""Renderer of an episode of a plant, as arrays, in a window or as a video file."""

from __future__ import annotations

import importlib.util
import math
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from thruster_env.core.checks import one_of, positive
from thruster_env.core.files import check_target, write_whole
from thruster_env.core.modules import to_install
from thruster_env.render.canvas import SIZE, History

if TYPE_CHECKING:
    import pygame

MODES = ("human", "rgb_array")


class PlantRenderer:
    """Draws an episode: `begin` it, `add` every moment from the reset's on, `draw` where a frame is wanted.

    A plant's class makes its pictures in `_make_pictures`, from `arguments`, and draws them in `_draw`. pygame is
    imported with the first renderer.

    Attributes:
        caption: of the window.
        moment: the NamedTuple of the truth at the end of a step.
        overlay: the NamedTuple of a filter's label and estimate.
        positive: names of the plant's arguments that must be positive numbers.
        remembered: names of attributes that a copy keeps, beside the history.
    """

    caption: ClassVar[str]
    moment: ClassVar[Any]
    overlay: ClassVar[Any]
    positive: ClassVar[tuple[str, ...]] = ()
    remembered: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self, mode: str, *, dt: float, frames_per_second: float, size: tuple[int, int] | None = None, **of_plant
    ):
        """Load pygame and draw what never moves.

        Args:
            mode: "human" (a window) or "rgb_array" (arrays).
            dt: sample time [s].
            frames_per_second: how many calls of `draw` a second a window keeps to [1/s].
            size: of the picture [px]; 640 x 400 if None.
            **of_plant: the plant's arguments, see its class.

        Raises:
            ValueError: for a mode that is not one of the two, or a number that is not positive.
            DependencyNotInstalled: if pygame is missing.
        """
        self.arguments = {
            "mode": mode, "dt": dt, "frames_per_second": frames_per_second, "size": size, **of_plant
        }  # fmt: skip
        for name in (*self.positive, "dt"):
            positive(name, self.arguments[name])
        self.mode = one_of("mode", mode, MODES)
        frame_time = 1.0 / positive("frames_per_second", frames_per_second)
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it would greet on standard output
        try:
            import pygame  # noqa: F401
        except ImportError as error:
            from gymnasium.error import DependencyNotInstalled  # here, because a model needs no Gymnasium

            raise DependencyNotInstalled(
                f"rendering needs pygame, which is not installed: {to_install('render')}"
            ) from error
        from thruster_env.render.canvas import Canvas

        self._canvas = Canvas(size or SIZE)
        self._make_pictures()
        self._canvas.keep()
        self._window = Window(frame_time, self.caption, size or SIZE) if mode == "human" else None
        self._history = History(self.moment._fields, self.overlay._fields[1:])
        self.begin()

    def _make_pictures(self) -> None:
        """Make what draws the parts of the picture on `_canvas`, what never moves included."""
        raise NotImplementedError

    def _draw(self, columns: dict[str, np.ndarray], count: int, label: str) -> None:
        """Draw the columns of the history; `count` moments were added, `label` names the filter."""
        raise NotImplementedError

    def __getstate__(self) -> tuple[dict, dict]:
        """Its arguments and history; pygame's surfaces cannot be copied."""
        return self.arguments, {name: getattr(self, name) for name in ("_history", *self.remembered)}

    def __setstate__(self, state: tuple[dict, dict]) -> None:
        """Redraw the pictures from the history."""
        arguments, remembered = state
        type(self).__init__(self, **arguments)
        vars(self).update(remembered)

    def begin(self) -> None:
        """Start an episode with an empty history."""
        self._history.clear()

    def add(self, moment: Any, overlay: Any = None) -> None:
        """Note a moment, a sample time after the one before; the first of an episode is that of the reset."""
        self._history.add(moment)
        self.amend(overlay)

    def amend(self, overlay: tuple | None) -> None:
        """Add a filter's estimate to the newest moment."""
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


LEAST_RATE = 20.0  # frames a second that are shown even if the steps come late [1/s]


class Window:
    """A window that keeps real time: it waits when it is early and leaves frames out when it is late."""

    def __init__(self, frame_time: float, caption: str, size: tuple[int, int] = SIZE):
        """Keep calls of `show` frame_time [s] apart; the window of a size [px] opens with the first."""
        global pygame
        import pygame

        self._size = size
        self._caption = caption
        self._frame_time = frame_time
        self._screen: pygame.Surface | None = None
        self._closed_by_hand = False

    def show(self, picture: Callable[[], pygame.Surface]) -> None:
        """Show a picture, unless it is late or the window was closed by hand, and wait until its time is over."""
        if self._closed_by_hand:
            return
        screen = self._screen
        if screen is None or not pygame.display.get_init():  # perhaps another env called pygame.quit()
            pygame.display.init()
            screen = self._screen = pygame.display.set_mode(self._size)
            pygame.display.set_caption(self._caption)
            self._due, self._shown_at = time.perf_counter(), -math.inf
        if pygame.event.get((pygame.QUIT, pygame.WINDOWCLOSE)):  # all other events are left to the caller
            self.close()
            self._closed_by_hand = True
            return
        start = time.perf_counter()
        if start <= self._due + self._frame_time or start - self._shown_at > 1 / LEAST_RATE:
            screen.blit(picture(), (0, 0))
            pygame.display.flip()
            self._shown_at = start
        now = time.perf_counter()
        # Time lost is made up for a little, not after a pause of whole seconds.
        self._due = max(self._due + self._frame_time, now - 2 / LEAST_RATE)
        time.sleep(max(0.0, self._due - now))

    def close(self) -> None:
        """Close the window."""
        self._closed_by_hand = False
        if self._screen is not None:
            pygame.display.quit()
            self._screen = None


FRAME_RATES = {".mp4": 50, ".gif": 25}  # frames a second, at most: browsers show no faster gif
OnStep = Callable[[int, int], None]  # steps so far, of how many


class Played(NamedTuple):
    """An episode that was shown."""

    steps: int
    total_reward: float
    seconds: float  # of the plant's time


def check_drawing(video: Path | None) -> None:
    """Raise ValueError unless a film can be drawn and written there; None for a window.

    Raises:
        ValueError: if a package of the extra `render` is missing, or the file cannot be written.
    """
    for package in ("pygame",) if video is None else ("pygame", "moviepy"):
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"drawing needs {package}, which is not installed: {to_install('render')}")
    if video is not None:
        if video.suffix not in FRAME_RATES:
            raise ValueError(f"--out must end in {' or '.join(FRAME_RATES)}, but got {str(video)!r}")
        check_target(video)


def steps_a_frame(video: Path | None, dt: float) -> int:
    """Every how many steps of dt [s] a film has a frame; 0 for a window, which draws itself."""
    return 0 if video is None else max(1, round(1 / (dt * FRAME_RATES[video.suffix])))


def write_video(video: Path, frames: Sequence[np.ndarray], rate: float) -> None:
    """Write frames, (height, width, 3) of uint8, at so many a second; the file is written whole or not at all."""
    from moviepy import ImageSequenceClip

    clip = ImageSequenceClip(list(frames), fps=rate)
    with tempfile.TemporaryDirectory() as aside:
        path = Path(aside) / video.name
        if video.suffix == ".gif":
            clip.write_gif(str(path), logger=None)
        else:
            clip.write_videofile(str(path), audio=False, logger=None)
        write_whole(video, path.read_bytes())
