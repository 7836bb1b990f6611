"""Show what a saved policy does: one episode as a film, or in a window."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np

from plants.rendering.film import OnStep, Played, check_drawing, steps_a_frame, write_film
from training.environments import make_environments
from training.saved import load, read_setup


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
    every = steps_a_frame(film, dt)
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
            write_film(film, frames, 1 / (dt * every))
    finally:
        venv.close()
    return Played(steps, total, steps * dt)
