"""Saved policies: a folder with the network, the normalisation of its observations, and the configuration.

    setup.json  policy.zip  normalisation.pkl  [replay.pkl]

Such a folder is written under another name and then renamed, so that a reader never finds a part of it. Files left
by a killed process have names that begin with a dot; `mend` removes them. Do not load files of unknown origin:
Stable-Baselines3 and this module use pickle.

`score` runs learnt and classical policies in the same loop, on the same held-out episodes, in native envs.
"""

from __future__ import annotations

import json
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from thruster_env.core.checks import one_of, short_repr
from thruster_env.render.renderer import OnStep, Played, check_drawing, steps_a_frame, write_video
from tuning.policies.algorithms import box_of, find_algorithm
from tuning.policies.controllers import ClassicalPolicy
from tuning.policies.environments import episode_steps, make_environments, make_single, native_of
from tuning.policies.setup import VERSION, Part, TrainingConfiguration, TrainingPlant, plant_of
from tuning.problems.data import training_seeds

SETUP, POLICY, NORMALISATION, REPLAY = "setup.json", "policy.zip", "normalisation.pkl", "replay.pkl"
FINAL, BEST, CHECKPOINTS = "final", "best", "checkpoints"
EVALUATIONS = "evaluations"
REPLACED, REMOVED = "old", "gone"  # how they end where something is replaced or removed


class SavedPolicy(NamedTuple):
    """A saved policy, which acts on observations of the env."""

    setup: TrainingConfiguration
    model: BaseAlgorithm
    normalisation: VecNormalize

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (n, 1) in [-1, 1] for observations (n, d), and the policy's state."""
        normalised = self.normalisation.normalize_obs(np.asarray(observation))
        return self.model.predict(normalised, state, episode_start, deterministic)


def save(folder: Path, setup: TrainingConfiguration, model: BaseAlgorithm, replay: bool = False) -> None:
    """Save a model with normalisation and training configuration; with `replay` the replay buffer, too."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    aside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        aside.chmod(0o755)
        (aside / SETUP).write_text(setup.as_json(), encoding="utf-8")
        model.save(aside / POLICY)
        normalisation = model.get_vec_normalize_env()
        if normalisation is None:
            raise ValueError("a policy must be saved with the normalisation of its envs, but its model has none")
        normalisation.save(str(aside / NORMALISATION))
        if replay and hasattr(model, "save_replay_buffer"):
            model.save_replay_buffer(aside / REPLAY)
        if folder.exists():
            old = folder.with_name(f".{folder.name}.{REPLACED}")
            shutil.rmtree(old, ignore_errors=True)
            os.replace(folder, old)
            os.replace(aside, folder)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(aside, folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def remove(folder: Path) -> None:
    """Remove a saved policy; it disappears in one step."""
    gone = folder.with_name(f".{folder.name}.{REMOVED}")
    shutil.rmtree(gone, ignore_errors=True)
    os.replace(folder, gone)
    shutil.rmtree(gone)


def find_saved(path: str | Path) -> Path:
    """The folder of a saved policy: the given one, or a training's final policy, else its latest checkpoint.

    Raises:
        ValueError: if there is none.
    """
    folder = Path(path)
    for candidate in (folder, folder / FINAL, latest_checkpoint(folder)):
        if candidate is not None and (candidate / POLICY).is_file():
            return candidate
    raise ValueError(f"a policy must be a folder that `thruster train` made, but {folder} holds none")


def latest_checkpoint(folder: Path) -> Path | None:
    """The checkpoint with the most steps in a training's folder."""
    checkpoints = [path for path in (folder / CHECKPOINTS).glob("*") if path.name.isdigit()]
    return max(checkpoints, key=lambda path: int(path.name), default=None)


def configuration_from_json(text: str, name: str) -> TrainingConfiguration:
    """The inverse of `TrainingConfiguration.as_json`; `name` is that of the file, for errors.

    Raises:
        ValueError: if it is not the text of a training configuration, or one of a later version.
    """
    try:
        entries = json.loads(text)
        version = entries.pop("version")
        if version > VERSION:
            raise ValueError(f"{name} must be of version {VERSION} or before, but is of version {version}")
        if "assumed_plant" in entries:
            raise KeyError("assumed_plant")
    except (json.JSONDecodeError, RecursionError, TypeError, KeyError, AttributeError):
        raise ValueError(f"{name} must hold the configuration of a policy, but got {short_repr(text)}") from None
    try:
        return TrainingConfiguration(**entries)
    except TypeError:  # an entry too many or too few
        raise ValueError(f"{name} must hold the configuration of a policy, but got {short_repr(text)}") from None
    except ValueError as error:
        raise ValueError(f"{error} (in {name})") from None


def read_configuration(folder: Path) -> TrainingConfiguration:
    """The training configuration in a folder; raises ValueError if there is none, or it is damaged."""
    path = folder / SETUP
    try:
        return configuration_from_json(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(
            f"a policy must come with its training configuration, but {path} is not readable: {error}"
        ) from None


def load(folder: Path, venv: VecEnv, training: bool = False) -> SavedPolicy:
    """Load a saved policy for envs with the observations of its training.

    Args:
        folder: from `find_saved`.
        venv: the envs.
        training: whether training continues; the model then gets the envs, normalised.

    Raises:
        ValueError: if a file is damaged, or was made with other observations or actions.
    """
    setup = read_configuration(folder)
    kind = find_algorithm(setup.algo).load_class()
    normalisation: VecNormalize = read_saved(folder / NORMALISATION, _normalisation)
    shape, env_shape = box_of(normalisation.observation_space).shape, box_of(venv.observation_space).shape
    if shape != env_shape:
        rule = f"a policy trained on observe={setup.observe!r} must see {shape[0]} numbers"
        raise ValueError(f"{rule}, but the env shows {env_shape[0]}")
    normalisation.set_venv(venv)
    normalisation.training, normalisation.norm_reward = training, training
    model = read_saved(
        folder / POLICY, lambda path: kind.load(path, env=normalisation if training else None, device="cpu")
    )
    if model.observation_space.shape != shape or model.action_space.shape != venv.action_space.shape:
        raise ValueError(f"policy and normalisation must belong together, but those of {folder} differ in size")
    if training and (folder / REPLAY).is_file():
        read_saved(folder / REPLAY, model.load_replay_buffer)
    return SavedPolicy(setup, model, normalisation)


def _normalisation(path: Path) -> VecNormalize:
    """As `VecNormalize.load`, but without envs, since their observations may differ."""
    normalisation = pickle.loads(path.read_bytes())
    if not isinstance(normalisation, VecNormalize):
        raise ValueError(f"it holds {type(normalisation).__name__}")
    return normalisation


def read_saved(path: Path, read: Callable[[Path], Any]) -> Any:
    """The result of `read` for a file; ValueError for any error of a damaged one."""
    try:
        return read(path)
    except FileNotFoundError:
        raise ValueError(f"a saved policy must have a {path.name}, but {path} is missing") from None
    except (pickle.UnpicklingError, Exception) as error:  # a damaged zip or pickle raises nearly anything
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path} must be a whole file as it was saved, but cannot be read: {reason}") from None


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


def classical_policy(name: str, setup: TrainingConfiguration) -> ClassicalPolicy:
    """A classical policy by the name of its controller, on the observation set of a training configuration.

    Raises:
        ValueError: for an unknown name, or a controller of states on an observation set without states.
    """
    plant = plant_of(setup.task)
    one_of("controller", name, plant.controllers)
    plant.check_observes(name, setup.observe)

    def training_returns(policy: ClassicalPolicy, copies: int, episodes: int) -> np.ndarray:
        seeds = list(training_seeds(setup.seed, episodes)) * copies
        return score(policy, setup, seeds).returns.reshape(copies, episodes)

    return plant.classical(name, make_single(setup), training_returns)
