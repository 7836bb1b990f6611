"""Show what a saved policy does: one episode as a film, or in a window."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from numerics.files import check_target, write_whole
from training.environments import make_environments
from training.saved import load, read_setup

FRAME_RATES = {".mp4": 50, ".gif": 25}  # frames a second, at most: browsers show no faster gif
OnStep = Callable[[int, int], None]  # steps so far, of how many


class Played(NamedTuple):
    """An episode that was shown."""

    steps: int
    total_reward: float
    seconds: float  # of the plant's time


def check_drawing(film: Path | None) -> None:
    """Raise ValueError unless a film can be drawn and written there; None for a window.

    Raises:
        ValueError: if a package of the extra `render` is missing, or the file cannot be written.
    """
    for package in ("pygame",) if film is None else ("pygame", "moviepy"):
        if importlib.util.find_spec(package) is None:
            raise ValueError(
                f"drawing needs {package}, which is not installed: pip install 'thruster-env[render]'"
            )
    if film is not None:
        if film.suffix not in FRAME_RATES:
            raise ValueError(f"--out must end in {' or '.join(FRAME_RATES)}, but got {str(film)!r}")
        check_target(film)


def play(folder: Path, film: Path | None, seed: int, on_step: OnStep = lambda steps, count: None) -> Played:
    """Run one episode of a saved policy and show it; without a film, in a window, at true speed.

    Args:
        folder: of the policy, from `saved.find_saved`.
        film: an .mp4 or .gif file, which is written whole or not at all.
        seed: of the episode.
        on_step: called after each step.

    Raises:
        ValueError: as `check_drawing` and `saved.load`.
    """
    check_drawing(film)
    setup = read_setup(folder)
    # A window draws itself at each step, an array when it is asked for.
    venv = make_environments(setup, [seed], native=False, render_mode="human" if film is None else "rgb_array")
    env = venv.unwrapped.envs[0]
    dt, count = env.unwrapped.plant.dt, gym.spec(setup.env_id).max_episode_steps
    every = 0 if film is None else max(1, round(1 / (dt * FRAME_RATES[film.suffix])))
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
        if film is not None:
            _write(film, frames, 1 / (dt * every))
    finally:
        venv.close()
    return Played(steps, total, steps * dt)


def _write(film: Path, frames: list[np.ndarray], rate: float) -> None:
    """Write a film whole or not at all."""
    from moviepy import ImageSequenceClip

    clip = ImageSequenceClip(frames, fps=rate)
    with tempfile.TemporaryDirectory() as aside:
        path = Path(aside) / film.name
        if film.suffix == ".gif":
            clip.write_gif(str(path), logger=None)
        else:
            clip.write_videofile(str(path), audio=False, logger=None)
        write_whole(film, path.read_bytes())
