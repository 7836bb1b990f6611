"""Scores of policies on held-out episodes: return, and tracking errors.

Learnt and classical policies run in the same loop, on the same seeds, in native envs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from thruster_env.render.renderer import OnStep, Played, check_drawing, steps_a_frame, write_video
from tuning.policies.environments import episode_steps, make_environments, native_of
from tuning.policies.plants.find import plant_of
from tuning.policies.plants.plant import Part, TrainingPlant
from tuning.policies.saved import load, read_configuration
from tuning.policies.setup import TrainingConfiguration


class Policy(Protocol):
    """A policy that acts on observations (n, d), as Stable-Baselines3's models do."""

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (n, p) in [-1, 1], and the policy's state."""


class Scores(NamedTuple):
    """Return and errors of a policy in B episodes."""

    returns: np.ndarray  # (B,)
    parts: Mapping[str, Part]  # errors by name, see `TrainingPlant.parts_of`


def score(policy: Policy, setup: TrainingConfiguration, seeds: Sequence[int]) -> Scores:
    """Run a policy, deterministic, for one episode of each seed in the envs of a setup.

    Args:
        policy: learnt or classical.
        setup: the training configuration of the envs, with the observations that the policy needs.
        seeds: held-out seeds.
    """
    steps = episode_steps(setup.env_id)
    venv, kind = make_environments(setup, seeds, endless=True), plant_of(setup.task)
    returns, recorded, alive = run_episodes(policy, venv, steps, kind)
    base: Any = native_of(venv).env.unwrapped
    return Scores(returns, kind.parts_of(recorded, alive, base.plant))


def run_episodes(
    policy: Policy, venv: VecEnv, steps: int, kind: TrainingPlant
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (B,), what the plant records (q, B, K), and the steps in which each first episode continues (B, K).

    A step that ends an episode is part of its return; its record is already the start of the next episode.
    """
    observations, state, native = venv.reset(), None, native_of(venv)
    starts, going = np.ones(venv.num_envs, dtype=bool), np.ones(venv.num_envs, dtype=bool)
    returns, rows, alive = np.zeros(venv.num_envs), [], []
    for _ in range(steps):
        actions, state = policy.predict(observations, state, starts, deterministic=True)
        observations, rewards, starts, _ = venv.step(actions)
        returns += np.where(going, rewards, 0.0)
        going &= ~starts
        rows.append(kind.recorded(native.arrays, np.asarray(observations)))
        alive.append(going.copy())
    return returns, np.array(rows).transpose(1, 2, 0), np.array(alive).T


# One episode of a saved policy as a video, or in a window.


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
