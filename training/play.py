"""One episode of a saved policy as a video, or in a window."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from numerics.files import check_target, write_whole
from training.environments import episode_steps, make_environments
from training.saved import load, read_configuration

FRAME_RATES = {".mp4": 50, ".gif": 25}  # largest number of frames per second: browsers limit that of a gif
OnStep = Callable[[int, int], None]  # steps so far, of how many


class Played(NamedTuple):
    """The result of an episode."""

    steps: int
    total_reward: float
    seconds: float  # of the plant's time


def check_drawing(video: Path | None) -> None:
    """Raise ValueError unless a video can be drawn and written there; None for a window.

    Raises:
        ValueError: if a package of the extra `render` is missing, or the file cannot be written.
    """
    for package in ("pygame",) if video is None else ("pygame", "moviepy"):
        if importlib.util.find_spec(package) is None:
            raise ValueError(
                f"drawing needs {package}, which is not installed: pip install 'thruster-env[render]'"
            )
    if video is not None:
        if video.suffix not in FRAME_RATES:
            raise ValueError(f"--out must end in {' or '.join(FRAME_RATES)}, but got {str(video)!r}")
        check_target(video)


def play(folder: Path, video: Path | None, seed: int, on_step: OnStep = lambda steps, count: None) -> Played:
    """Run one episode of a saved policy and record it; without a video, show it in a window in real time.

    Args:
        folder: folder of the policy, from `saved.find_saved`.
        video: an .mp4 or .gif file, which is written completely or not at all.
        seed: seed of the episode.
        on_step: called after each step.

    Raises:
        ValueError: as `check_drawing` and `saved.load`.
    """
    check_drawing(video)
    setup = read_configuration(folder)
    # A window is drawn at each step, an array on request.
    venv = make_environments(setup, [seed], native=False, render_mode="human" if video is None else "rgb_array")
    base: Any = venv.unwrapped  # single envs side by side
    env = base.envs[0]
    dt, count = env.unwrapped.plant.dt, episode_steps(setup.env_id)
    every = 0 if video is None else max(1, round(1 / (dt * FRAME_RATES[video.suffix])))
    try:
        policy = load(folder, venv)
        observation, state, ended = venv.reset(), None, np.ones(1, dtype=bool)
        frames = [env.render()] if every else []
        steps, total = 0, 0.0
        while steps == 0 or not ended[0]:
            action, state = policy.predict(observation, state, ended)
            observation, rewards, ended, _ = venv.step(action)
            steps, total = steps + 1, total + float(rewards[0])
            if every and steps % every == 0 and not ended[0]:  # at its end the env has been reset
                frames.append(env.render())
            on_step(steps, count)
        if video is not None:
            _write(video, frames, 1 / (dt * every))
    finally:
        venv.close()
    return Played(steps, total, steps * dt)


def _write(video: Path, frames: list[np.ndarray], rate: float) -> None:
    """Write a video completely or not at all."""
    from moviepy import ImageSequenceClip

    clip = ImageSequenceClip(frames, fps=rate)
    with tempfile.TemporaryDirectory() as aside:
        path = Path(aside) / video.name
        if video.suffix == ".gif":
            clip.write_gif(str(path), logger=None)
        else:
            clip.write_videofile(str(path), audio=False, logger=None)
        write_whole(video, path.read_bytes())
