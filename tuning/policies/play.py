"""One episode of a saved policy as a video, or in a window."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.render.renderer import OnStep, Played, check_drawing, steps_a_frame, write_video
from tuning.policies.environments import episode_steps, make_environments
from tuning.policies.saved import load, read_configuration


def play(
    folder: Path,
    video: Path | None,
    seed: int,
    on_step: OnStep = lambda steps, count: None,
    size: tuple[int, int] | None = None,
) -> Played:
    """Run one episode of a saved policy and record it; without a video, show it in a window in real time.

    Args:
        folder: folder of the policy, from `saved.find_saved`.
        video: an .mp4 or .gif file, which is written completely or not at all.
        seed: seed of the episode.
        on_step: called after each step.
        size: of the pictures, (width, height) [px]; the env's own if None.

    Raises:
        ValueError: as `check_drawing` and `saved.load`.
    """
    check_drawing(video)
    setup = read_configuration(folder)
    if size is not None:
        setup = replace(setup, env_arguments={**setup.env_arguments, "render_size": size})
    # A window is drawn at each step, an array on request.
    venv = make_environments(setup, [seed], native=False, render_mode="human" if video is None else "rgb_array")
    base: Any = venv.unwrapped  # single envs side by side
    env = base.envs[0]
    dt, count = env.unwrapped.plant.dt, episode_steps(setup.env_id)
    every = steps_a_frame(video, dt)
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
            write_video(video, frames, 1 / (dt * every))
    finally:
        venv.close()
    return Played(steps, total, steps * dt)
