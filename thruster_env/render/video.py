"""Films of an episode, .mp4 or .gif; needs moviepy, of the extra `render`."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.extras import to_install
from thruster_env.core.files import check_target, write_whole

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
