"""Train a policy, with evaluations, checkpoints and TensorBoard; an interrupted training can be continued.

In order: settings with which torch trains such small networks fastest on a CPU; the model of Stable-Baselines3
that a training configuration asks for; the training.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor, nn
from torch.distributions import Distribution

from thruster_env.core.files import write_whole
from thruster_env.core.parallel import PASSIVE, one_thread, waiting
from tuning.policies.algorithms import find_algorithm
from tuning.policies.environments import make_environments, seed_episodes
from tuning.policies.saved import (
    BEST,
    CHECKPOINTS,
    EVALUATIONS,
    FINAL,
    POLICY,
    REPLACED,
    SETUP,
    latest_checkpoint,
    load,
    read_configuration,
    read_saved,
    remove,
    save,
    score,
)
from tuning.policies.setup import TrainingConfiguration
from tuning.problems.data import SEEDS_APART, training_seeds
from tuning.search.study import stop_on_interrupt

TAKEN = torch.float32, torch.float64
VALIDATION_EPISODES = 32  # of an evaluation during training; always the same ones
KEPT = 2  # checkpoints
OnProgress = Callable[[int, float], None]  # steps, and the mean return of the last evaluation (NaN before it)


class EpochBuffer(RolloutBuffer):
    """A `RolloutBuffer` with the same minibatches, to the bit, in a third of the time.

    Stable-Baselines3 gathers and copies six arrays for each minibatch. Here all samples of an epoch are gathered
    at once, in the same random order, and a minibatch is a part of that.
    """

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """The minibatches of one epoch; all samples in one without `batch_size`."""
        (epoch,) = super().get()
        size = len(epoch.actions) if batch_size is None else int(batch_size)  # torch refuses NumPy's integers
        for parts in zip(*(tensor.split(size) for tensor in epoch), strict=True):
            yield RolloutBufferSamples(*parts)


@contextmanager
def epoch_minibatches(model: BaseAlgorithm) -> Iterator[None]:
    """Within this context a model with a `RolloutBuffer` has an `EpochBuffer` in its place."""
    holder: Any = model
    before = getattr(holder, "rollout_buffer", None)
    if type(before) is not RolloutBuffer:
        yield
        return
    names = ("buffer_size", "observation_space", "action_space", "device", "gae_lambda", "gamma", "n_envs")
    holder.rollout_buffer = EpochBuffer(**{name: getattr(before, name) for name in names})
    try:
        yield
    finally:
        holder.rollout_buffer = before


class _Tanh(torch.autograd.Function):
    """y = tanh(x), dy/dx = 1 - y^2."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = _evaluate(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, y)


class NumpyTanh(nn.Module):
    """tanh(x), equal to `torch.nn.Tanh` except for rounding; torch's own for types that NumPy does not have."""

    def forward(self, x: Tensor) -> Tensor:
        """Return tanh(x)."""
        if x.dtype not in TAKEN or not x.is_cpu or not x.ndim:
            return torch.tanh(x)
        return _Tanh.apply(x) if x.requires_grad else _evaluate(x)


def _evaluate(x: Tensor) -> Tensor:
    return torch.from_numpy(np.tanh(x.detach().numpy()))


@contextmanager
def numpys_tanh(network: nn.Module) -> Iterator[None]:
    """Within this context each `torch.nn.Tanh` of a network is NumPy's; saved files do not record it.

    torch's comes from Intel's library and takes ten times as long on an AMD, longer than a layer's product.
    """
    activations = [
        (parent, name, child)
        for parent in network.modules()
        for name, child in parent.named_children()
        if type(child) is nn.Tanh
    ]
    quick = NumpyTanh()
    try:
        for parent, name, _ in activations:
            setattr(parent, name, quick)
        yield
    finally:
        for parent, name, child in activations:
            setattr(parent, name, child)


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """Within this context distributions do not look for NaN in every argument.

    A policy that has become NaN is still noticed, in the same step: the envs refuse its actions.
    """
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def fuse_optimizers(model: BaseAlgorithm) -> None:
    """Have each Adam optimizer of a model update all parameters in one call, equal to rounding.

    Stable-Baselines3 leaves torch's default, a dozen calls for each parameter, which take longer than the numbers.
    """
    parameters: Any = model.get_parameters()  # that of optimizers, too, of which its annotation does not know
    for state in parameters.values():
        for group in state.get("param_groups", ()):
            group["fused"] = True
    model.set_parameters(parameters)


@contextmanager
def learning(model: BaseAlgorithm) -> Iterator[None]:
    """Within this context a model of Stable-Baselines3 learns as quickly as it can on one core.

    The result is the same except for rounding, of its optimizers and of tanh. torch has one thread and checks no
    arguments of distributions, minibatches are parts of an epoch's samples, and worker threads of vector envs
    sleep while torch works.

    Args:
        model: on the CPU.
    """
    fuse_optimizers(model)
    with (
        waiting(PASSIVE),
        one_thread(),
        unchecked_distributions(),
        epoch_minibatches(model),
        numpys_tanh(model.policy),
    ):
        yield


def new_model(setup: TrainingConfiguration, envs: VecEnv, tensorboard: Path | None = None) -> BaseAlgorithm:
    """A model that has learnt nothing yet, with its envs normalised.

    Args:
        setup: the training configuration.
        envs: from `make_environments`.
        tensorboard: folder of TensorBoard's files; no files without one.
    """
    algorithm = find_algorithm(setup.algo)
    kind = algorithm.load_class()
    numbers: dict[str, Any] = deepcopy(dict(setup.hyperparameters))  # off-policy ones write into policy_kwargs
    rate = numbers["learning_rate"]
    # The last rollout may exceed the requested steps: `remaining` is then negative.
    numbers["learning_rate"] = lambda remaining: rate * max(remaining, 0.0)
    if "noise_std" in numbers:
        deviation = numbers.pop("noise_std")
        numbers["action_noise"] = NormalActionNoise(np.zeros(1), np.full(1, deviation))
    normalised = VecNormalize(envs, gamma=numbers["gamma"])
    log = None if tensorboard is None else str(tensorboard)
    return kind(algorithm.policy, normalised, seed=setup.seed, tensorboard_log=log, device="cpu", **numbers)


class Trained(NamedTuple):
    """The result of a training."""

    folder: Path
    steps: int  # total number
    learnt: int  # number in this call
    seconds: float  # of this call
    curve: list[tuple[int, float]]  # steps and mean return of each evaluation
    interrupted: bool
    idle: float = math.nan  # mean return of actions of zero on the episodes of the evaluations; NaN without any


def reopen(folder: Path, steps: int) -> None:
    """Make the final policy of a training its latest checkpoint, at its number of steps, to continue from it."""
    checkpoint = folder / CHECKPOINTS / f"{steps:09d}"
    checkpoint.parent.mkdir(exist_ok=True)
    if checkpoint.exists():  # the same policy, perhaps with its replay buffer
        remove(folder / FINAL)
    else:
        os.replace(folder / FINAL, checkpoint)


def train(
    setup: TrainingConfiguration,
    folder: str | Path,
    *,
    evaluations: int = 20,
    checkpoints: int = 10,
    native: bool = True,
    tensorboard: bool = True,
    on_progress: OnProgress = lambda steps, mean_return: None,
) -> Trained:
    """Train a policy until it has learnt from `setup.steps` steps, and save it.

    The folder gets `final/`, `best/` (by evaluation), `checkpoints/`, the evaluations and TensorBoard's files. If
    it holds a training with the same configuration, this one continues from its latest checkpoint, with other
    episodes. Ctrl-C ends it after the running step and saves a checkpoint.

    Args:
        setup: the training configuration.
        folder: folder of all results.
        evaluations: number of evaluations of the policy, always on the same episodes; none of them is held out.
        checkpoints: number of checkpoints; the last two are kept.
        native: whether all copies are stepped in one call.
        tensorboard: whether to write logs for TensorBoard.
        on_progress: called after each step of the envs.

    Raises:
        ValueError: if the folder contains something else, or a checkpoint in it is damaged.
    """
    folder = Path(folder)
    start = _start(folder, setup)
    seeds = training_seeds(setup.seed, VALIDATION_EPISODES + setup.num_envs)
    envs = make_environments(setup, seeds[VALIDATION_EPISODES:], native=native)
    validation = make_environments(setup, seeds[:VALIDATION_EPISODES])
    model = _model(setup, envs, start, folder / "tensorboard" if tensorboard else None)
    # A model seeds its envs again, by its own seed; and a continued training has had the first episodes.
    seed_episodes(envs, _episodes_after(setup, model.num_timesteps))
    evaluation = _Evaluation(
        setup, folder, validation, seeds[:VALIDATION_EPISODES], evaluations, model.num_timesteps
    )
    before = model.num_timesteps
    remaining = setup.steps - before
    if remaining > 0 and start == folder / FINAL:
        reopen(folder, before)
    if not (folder / FINAL).exists():
        write_whole(folder / SETUP, setup.as_json())
    began = time.perf_counter()
    with stop_on_interrupt() as interrupted, learning(model):
        watch = _Watch(setup, folder, checkpoints, evaluation, interrupted, on_progress)
        if remaining > 0:
            model.learn(remaining, [evaluation, watch], tb_log_name=setup.observe, reset_num_timesteps=False)
        stopped = interrupted()
    if stopped:
        watch.save()
    elif not (folder / FINAL).exists():
        save(folder / FINAL, setup, model)
    curve = list(zip(evaluation.evaluations_timesteps, evaluation.returns, strict=True))
    seconds = time.perf_counter() - began
    idle = _Idle(envs.action_space)
    envs.close()
    validation.close()
    zero = score(idle, setup, seeds[:VALIDATION_EPISODES]).returns.mean() if curve else math.nan
    return Trained(folder, model.num_timesteps, model.num_timesteps - before, seconds, curve, stopped, float(zero))


class _Idle:
    """Actions of zero: planes and thrust held in the middle or, with a controller, that controller alone."""

    def __init__(self, space):
        """Take the space of an env's actions."""
        self._shape = space.shape

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (n, p) of zero."""
        return np.zeros((len(observation), *self._shape), dtype=np.float32), state


# Names of what is being written: the final one, and what `tempfile` and others put behind it.
ASIDE = re.compile(rf"\.({re.escape(SETUP)}|{EVALUATIONS}|{FINAL}|{BEST}|\d+)\.(.+)")


def mend(folder: Path) -> None:
    """Remove the incomplete files of a killed process from a training's folder; anything else stays as it is.

    A policy that was about to be replaced is restored if its successor is missing.
    """
    if not folder.is_dir():
        return
    ours = (folder / SETUP).is_file() or all(ASIDE.fullmatch(path.name) for path in folder.iterdir())
    for path in [*folder.iterdir(), *(folder / CHECKPOINTS).glob(".*")] if ours else []:
        match = ASIDE.fullmatch(path.name)
        if match is None:
            continue
        name, end = match.groups()
        if end == REPLACED and not path.with_name(name).exists():
            os.replace(path, path.with_name(name))
        elif path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def _start(folder: Path, setup: TrainingConfiguration) -> Path | None:
    """The saved policy to continue from, if any."""
    mend(folder)
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return None
    if not (folder / SETUP).is_file():
        raise ValueError(f"the folder must be new, empty or that of a training, but {folder} contains other files")
    differences = read_configuration(folder).differences(setup)
    if differences:
        rule = f"{folder} must contain a training of the same configuration to continue, but differs in"
        raise ValueError(f"{rule} {', '.join(differences)}: give another folder")
    latest = latest_checkpoint(folder)
    return folder / FINAL if (folder / FINAL / POLICY).is_file() else latest


def _episodes_after(setup: TrainingConfiguration, steps: int) -> list[int]:
    """Seeds of the first episodes of every copy of a training that starts, or continues, after some steps."""
    first = VALIDATION_EPISODES + steps % (SEEDS_APART // 4)  # far from held-out seeds
    return list(training_seeds(setup.seed, first + setup.num_envs)[first:])


def _model(
    setup: TrainingConfiguration, envs: VecEnv, start: Path | None, tensorboard: Path | None
) -> BaseAlgorithm:
    if start is None:
        return new_model(setup, envs, tensorboard)
    model = load(start, envs, training=True).model
    model.tensorboard_log = None if tensorboard is None else str(tensorboard)
    return model


def _evaluations_in(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return {name: file[name] for name in ("timesteps", "results", "ep_lengths")}


class _Evaluation(EvalCallback):
    """Evaluate on the same episodes each time, keep the best policy, continue earlier evaluations."""

    def __init__(self, setup: TrainingConfiguration, folder: Path, envs: VecEnv, seeds, count: int, steps: int):
        self._seeds, self._setup, self._best = seeds, setup, folder / BEST
        self.returns: list[float] = []
        normalised = VecNormalize(envs, training=False, norm_reward=False)
        every = max(1, setup.steps // (count * setup.num_envs))
        super().__init__(normalised, n_eval_episodes=len(seeds), eval_freq=every, log_path=str(folder), verbose=0)
        path = self._path = folder / f"{EVALUATIONS}.npz"
        self.log_path = str(
            path.with_name(f".{EVALUATIONS}")
        )  # under another name: a full disk then destroys no earlier ones
        if steps and path.is_file():
            before = read_saved(path, _evaluations_in)
            earlier = before["timesteps"] <= steps
            self.evaluations_timesteps = before["timesteps"][earlier].tolist()
            self.evaluations_results = before["results"][earlier].tolist()
            self.evaluations_length = before["ep_lengths"][earlier].tolist()
            self.returns = [float(np.mean(row)) for row in self.evaluations_results]
            self.best_mean_reward = max(self.returns, default=-np.inf)

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq:
            return True
        best = self.best_mean_reward
        seed_episodes(self.eval_env, self._seeds)
        goes_on = super()._on_step()
        os.replace(f"{self.log_path}.npz", self._path)
        self.returns.append(float(np.mean(self.evaluations_results[-1], dtype=np.float64)))
        if self.best_mean_reward > best:
            save(self._best, self._setup, self.model)
        return goes_on


class _Watch(BaseCallback):
    """Report progress, save checkpoints, and end on Ctrl-C."""

    def __init__(
        self,
        setup: TrainingConfiguration,
        folder: Path,
        count: int,
        evaluation: _Evaluation,
        interrupted,
        on_progress,
    ):
        super().__init__()
        self._setup, self._folder = setup, folder / CHECKPOINTS
        self._every = max(1, setup.steps // (count * setup.num_envs))
        self._evaluation, self._interrupted, self._on_progress = evaluation, interrupted, on_progress

    def _on_step(self) -> bool:
        if self.n_calls % self._every == 0:
            self.save()
        returns = self._evaluation.returns
        self._on_progress(self.num_timesteps, returns[-1] if returns else float("nan"))
        return not self._interrupted()

    def save(self) -> None:
        """Save a checkpoint, and remove those before the last ones."""
        save(self._folder / f"{self.model.num_timesteps:09d}", self._setup, self.model, replay=True)
        for old in sorted(path for path in self._folder.glob("*") if path.name.isdigit())[:-KEPT]:
            remove(old)
