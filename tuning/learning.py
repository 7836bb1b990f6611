"""The training of an estimator with a network: windows of many runs, and checks on validation runs.

In order: the loss; the training; the filter it starts from, with the scales of its quantities; trained estimators
beside filters on held-out runs, also longer and noisier ones.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from filters.consistency.nees import Interval
from filters.engine.batch import run
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from filters.learned import read_estimator
from filters.learned.estimator import Equations, LearnedEstimator, Scales, Track
from filters.learned.filters import LEARNED
from filters.tensors.stages import density, factor
from thruster_env.core.angles import wrapped_where
from thruster_env.core.parallel import one_thread
from thruster_env.model.state_space import StateSpaceModel
from tuning.evaluation.baselines import ORACLE, baselines
from tuning.evaluation.evaluate import NOTHING, Evaluation, evaluate, score_ratio, values_of
from tuning.problems.check import data_of
from tuning.problems.data import Data
from tuning.problems.env_problem import measurement_noise
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Problem
from tuning.problems.scenario import PlantScenario

LARGEST_GRADIENT = 1.0  # its norm is cut to this: one outlier shall not undo what was learned
START = "ekf"
SMALLEST = 1e-12  # of a scale: a quantity that stays at zero is divided by this, and stays there
LARGER = 4.0  # factor on R
HELD_OUT, LONGER, NOISIER = "held out", "twice as long", f"R x {LARGER:g}"


class Settings(NamedTuple):
    """How an estimator is trained.

    Attributes:
        steps: updates of the network's weights.
        batch: runs in each.
        window: steps of a run over which gradients go back; the next window begins where the last one ended.
        rate: Adam's step size at first; it falls to a hundredth along half a cosine.
        checks: evaluations on validation runs.
    """

    steps: int
    batch: int
    window: int
    rate: float
    checks: int = 20


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


def starting_filter(problem: Problem, data: Data, seed: int) -> tuple[str, Filter]:
    """The extended Kalman filter that a training starts from: the baseline that is best on the training runs.

    The oracle is none of them: a training does not know the plant's Q and R.

    Returns:
        Its label, such as "ekf scaled default", and the filter.
    """
    choices = {name: choice for name, choice in baselines(START, problem, seed).items() if name != ORACLE}
    filters = {f"{START} {name}": choice.filter(problem) for name, choice in choices.items()}
    return min(filters.items(), key=lambda entry: values_of(entry[1], data, problem.scale).score.value)


def new_estimator(
    kind: str, filter_: Filter, data: Data, seed: int, start: str | Path | None = None, **options: int
) -> LearnedEstimator:
    """An estimator that is not trained yet, or that continues from the weights of a file.

    Args:
        kind: of the estimator.
        filter_: the filter that it starts from.
        data: training runs, from which its scales are taken.
        seed: of its first weights.
        start: file of a trained estimator of the same kind and model; None for new weights.
        **options: of the estimator.

    Raises:
        ValueError: for a wrong option, or a file of another kind or model.
    """
    if start is not None:
        trained = read_estimator(start)
        if trained.name != kind or options:
            raise ValueError(
                f"start must be a {kind}'s file, and options its own, but got {start}, a {trained.name}"
            )
        return trained(filter_.model)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return LEARNED[kind](filter_.model, scales_of(filter_, data), **options)


def scales_of(filter_: Filter, data: Data) -> Scales:
    """Sizes of a filter's quantities over the steps of some runs that count; see `Scales`.

    The gain is that of the corrections K v that are nearest to the filter's, by least squares.
    """
    runs, model = data.seen, filter_.model
    estimates = run(filter_, runs.filter_keys, runs.inputs, runs.measurements)
    states = data.known_states
    mean, n = estimates.means, states.shape[-1]
    innovation = np.where(np.isnan(runs.measurements), 0.0, estimates.innovations)
    counted = np.isfinite(states).all(axis=-1)
    later = counted[:, 1:]
    corrected = wrapped_where(mean[:, 1:] - _predicted(model, mean, runs.inputs), model.shape.state_angles)
    changes = wrapped_where(np.diff(mean, axis=1), model.shape.state_angles)
    measured = wrapped_where(np.diff(runs.measurements, axis=1), model.shape.measurement_angles)
    error = np.ones(model.n)
    error[:n] = _size(wrapped_where((mean[..., :n] - states)[counted], model.shape.state_angles[:n]))
    truth = states[counted] if n == model.n else mean[counted]
    _check_measured(runs.measurements, model)
    gain = np.linalg.lstsq(innovation[:, 1:][later], corrected[later], rcond=None)[0].T
    spread = _large(np.nanstd(runs.measurements, axis=(0, 1)))
    steps = _size(measured[later])
    return Scales(
        truth.mean(axis=0),
        _large(truth.std(axis=0)),
        _size(changes[later]),
        _size(corrected[later]),
        error,
        np.nanmean(runs.measurements, axis=(0, 1)),
        spread,
        np.where(np.isnan(steps), spread, steps),  # of a channel that is never measured twice in a row
        _size(innovation[counted]),
        runs.inputs.mean(axis=(0, 1)),
        _large(runs.inputs.std(axis=(0, 1))),
        gain,
    )


def _check_measured(measurements: np.ndarray, model: StateSpaceModel) -> None:
    """Raise ValueError unless each channel (B, K + 1, m) has measurements, without which it has no scale."""
    for channel, values in zip(model.measurements, np.moveaxis(measurements, -1, 0), strict=True):
        if not np.isfinite(values).any():
            raise ValueError(f"a training must have measurements of each channel, but {channel.symbol} has none")


def _predicted(model: StateSpaceModel, mean: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """The predictions (B, K, n) from means (B, K + 1, n) and inputs (B, K, p)."""
    x, u = (torch.tensor(values).flatten(0, 1) for values in (mean[:, :-1], inputs))
    return Equations(model).moved(x, u).numpy().reshape(mean[:, 1:].shape)


def _size(values: np.ndarray) -> np.ndarray:
    """Root mean squares of rows (rows, size); NaN for a column of which nothing is known."""
    counts, sums = (~np.isnan(values)).sum(axis=0), np.nansum(values**2, axis=0)
    return _large(np.sqrt(np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)))


def _large(values: np.ndarray) -> np.ndarray:
    return np.maximum(values, SMALLEST)


def twice_as_long(problem: Problem, seeds: Sequence[int]) -> Data | None:
    """Runs of a problem that are twice as long; None of one whose runs have their length."""
    if isinstance(problem, PlantScenario):
        return problem.replace(steps=2 * problem.steps).data(seeds)
    if isinstance(problem, ModelProblem) and not isinstance(problem.inputs, np.ndarray):
        longer = copy.copy(problem)
        longer.steps = 2 * problem.steps
        return longer.make(tuple(seeds))
    return None


def with_larger_noise(problem: Problem, data: Data, factor: float = LARGER) -> Data:
    """Runs whose measurements have a further noise, of covariance (factor - 1) R, so that theirs is factor R.

    R is the plant's, or where that is unknown the data sheet's. Random numbers follow from the runs' keys.
    """
    model = problem.model(**(problem.untuned if problem.true is None else problem.true))
    steps, keys = np.arange(data.measurements.shape[1]), data.filter_keys.astype(np.int64)
    noise = measurement_noise(keys, steps, (factor - 1.0) * model.measurement_noise_cov)
    return data._replace(measurements=data.measurements + noise)


class Standing(NamedTuple):
    """A filter or an estimator on held-out runs, and on runs that differ from those of the training.

    Attributes:
        label: for tables.
        name: of the filter.
        evaluations: by "held out", "twice as long" and "R x 4"; the second is missing if there are none.
    """

    label: str
    name: str
    evaluations: Mapping[str, Evaluation]

    def ratio(self, first: Standing, runs: str = HELD_OUT) -> Interval:
        """Score over that of another one, paired on the same runs; NaN where there are none."""
        if runs not in self.evaluations:
            return NOTHING
        return score_ratio(self.evaluations[runs], first.evaluations[runs])


def standings(filters: Mapping[str, Filter], problem: Problem, seeds: Sequence[int]) -> list[Standing]:
    """Filters by label on held-out seeds of a problem, and on the same with longer runs and larger noise."""
    data = data_of(problem, seeds)
    runs = {HELD_OUT: data, LONGER: twice_as_long(problem, seeds), NOISIER: with_larger_noise(problem, data)}
    results = []
    for label, filter_ in filters.items():
        evaluations = {
            name: evaluate(filter_, data_, problem.scale) for name, data_ in runs.items() if data_ is not None
        }
        results.append(Standing(label, filter_.name, evaluations))
    return results
