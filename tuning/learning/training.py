"""The training of an estimator with a network: windows of many runs, and checks on runs of their own."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from filters.estimators.foreign import ForeignFilter
from filters.learned.estimator import LearnedEstimator, Track
from filters.tensors.stages import density, factor
from thruster_env.core.threads import one_thread
from tuning.evaluation.evaluate import values_of
from tuning.learning.settings import Settings
from tuning.problems.data import Data

# What the training of an estimator minimises: squared errors, or the log density of the truth.


class Loss:
    """The loss of a step, of means (B, n) and covariances: zero for runs that are not scored there.

    Without a covariance the weighted mean square, with weights that have the slope of the score where the starting
    filter is; with one the log density of the true states that count:

        sum over states of w e^2,  w = 1/(scale * error of the starting filter)
        (e' P^-1 e + log det 2 pi P)/2

    It is NaN where P is not positive definite; the training then leaves out the update.
    """

    def __init__(self, estimator: LearnedEstimator, scale):
        """Of an estimator and the scale (n,) of a problem's score, infinite for states that do not count."""
        scale = torch.as_tensor(scale, dtype=torch.float64)
        self._states = torch.isfinite(scale).nonzero()[:, 0]
        self._has_covariance = estimator.has_covariance
        self._wrapped = estimator.equations.of_state
        count = len(self._states)
        self._weights = 1.0 / (scale * estimator.scale_error[: len(scale)])[self._states] / count
        self._extra = estimator.model.n - len(scale)

    def __call__(self, track: Track, truth: Tensor, scored: Tensor) -> Tensor:
        """The sum over the runs (B,) that are scored, at a step with true states (B, n)."""
        known = torch.where(scored[:, None], truth, 0.0)
        all_states = torch.nn.functional.pad(known, (0, self._extra))
        error = self._wrapped(track.mean - all_states)[:, self._states]
        if not self._has_covariance:
            return torch.where(scored, (self._weights * error**2).sum(-1), 0.0).sum()
        assert track.cov is not None
        root = factor(track.cov[:, self._states[:, None], self._states])
        return torch.where(scored, -density(error, root, torch.ones_like(error, dtype=torch.bool)), 0.0).sum()


LARGEST_GRADIENT = 1.0  # its norm is cut to this: one outlier shall not undo what was learned


class Check(NamedTuple):
    """An evaluation on validation runs.

    Attributes:
        step: updates so far.
        loss: mean over the updates since the last check; NaN at first.
        score: of the validation runs, the problem's.
        best: whether it is the lowest so far.
    """

    step: int
    loss: float
    score: float
    best: bool


def train(
    estimator: LearnedEstimator,
    data: Data,
    validation: Data,
    scale,
    settings: Settings,
    seed: int = 0,
    on_step: Callable[[int], None] = lambda step: None,
    on_check: Callable[[Check], None] = lambda check: None,
    stopped: Callable[[], bool] = lambda: False,
) -> list[Check]:
    """Train an estimator in place; it ends with the weights of its best check, the untrained ones included.

    Args:
        estimator: to be trained.
        data: training runs with true states.
        validation: other runs, on which the best weights are chosen.
        scale: (n,) of the problem's score.
        settings: how.
        seed: of the order of the runs.
        on_step: called after each update.
        on_check: called after each check.
        stopped: whether to end now, with the best weights so far.

    Returns:
        All checks.
    """
    with one_thread():
        return _train(estimator, data, validation, scale, settings, seed, on_step, on_check, stopped)


def _train(
    estimator: LearnedEstimator,
    data: Data,
    validation: Data,
    scale,
    settings: Settings,
    seed: int,
    on_step: Callable[[int], None],
    on_check: Callable[[Check], None],
    stopped: Callable[[], bool],
) -> list[Check]:
    filter_ = ForeignFilter(model=estimator.model, estimator=estimator)
    optimiser = torch.optim.Adam(estimator.parameters(), settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.steps, 0.01 * settings.rate)
    checks: list[Check] = []
    best = None

    def check(step: int, values: list[float]) -> None:
        nonlocal best
        with np.errstate(over="ignore"):  # of a network that has got worse
            score = values_of(filter_, validation, scale).score.value
        is_best = np.isfinite(score) and all(not score >= check_.score for check_ in checks)
        if is_best:
            best = copy.deepcopy(estimator.state_dict())
        checks.append(Check(step, float(np.mean(values)) if values else np.nan, score, bool(is_best)))
        on_check(checks[-1])

    check(0, [])
    recent: list[float] = []
    losses = _losses(estimator, data, settings, Loss(estimator, scale), np.random.default_rng(seed))
    for step in range(1, settings.steps + 1):
        value = next(losses)
        optimiser.zero_grad()
        value.backward()
        norm = torch.nn.utils.clip_grad_norm_(estimator.parameters(), LARGEST_GRADIENT)
        if torch.isfinite(norm):
            optimiser.step()
            recent.append(value.item())
        schedule.step()
        on_step(step)
        if step * settings.checks // settings.steps > (step - 1) * settings.checks // settings.steps:
            check(step, recent)
            recent = []
        if stopped():
            break
    if best is not None:
        estimator.load_state_dict(best)
    return checks


def _losses(
    estimator: LearnedEstimator, data: Data, settings: Settings, loss: Loss, generator: np.random.Generator
) -> Iterator[Tensor]:
    """Endless losses, each of a window of a batch of runs, in the order of time within a batch.

    Steps before the first one that is scored have no derivatives.
    """
    runs, scored = data.seen, torch.tensor(data.scored)
    u, z, truth = (torch.tensor(part) for part in (runs.inputs, runs.measurements, data.known_states))
    count, times = scored.shape
    first = max(data.first_scored, 1)
    while True:
        batch = torch.tensor(generator.permutation(count)[: settings.batch])
        with torch.no_grad():
            track = estimator.begin(runs.filter_keys[batch], z[batch, 0])
            for k in range(1, min(first, times)):
                track = estimator.advance(track, u[batch, k - 1], z[batch, k])
        for begin in range(first, times, settings.window):
            steps = slice(begin, begin + settings.window)
            total, track = torch.zeros((), dtype=torch.float64), track.detach()
            for k in range(*steps.indices(times)):
                track = estimator.advance(track, u[batch, k - 1], z[batch, k])
                total = total + loss(track, truth[batch, k], scored[batch, k])
            if counted := scored[batch, steps].sum():
                yield total / counted
