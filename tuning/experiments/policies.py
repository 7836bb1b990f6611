"""A comparison of policies: its runs, each a training or a classical policy, their execution, and figures.

Beside the three noise levels there are variants at medium noise: filters with other Q and R (`untuned`, `tuned`),
and three situations in which filter and controller assume a wrong model (`WRONG`); a policy is trained in the
situation itself. Finished runs are stored and never repeated. A `Figure` is a mean over training seeds whose
interval contains the variation of policies and of episodes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from filters.consistency.nees import Interval
from thruster_env.core.files import write_whole
from thruster_env.core.parallel import Where, one_thread, task_map
from tuning.api.result import plain_data
from tuning.plants.thruster import Scenario, find_scenario
from tuning.policies.environments import make_environments
from tuning.policies.learn import train
from tuning.policies.saved import FINAL, Policy, Scores, classical_policy, load, score
from tuning.policies.setup import Part, TrainingConfiguration, make_configuration
from tuning.problems.data import held_out_seeds
from tuning.search.plan import Plan
from tuning.search.storage import quiet_optuna
from tuning.search.study import open_study, run_study

TASK = "manoeuvre"
NOISES = {"low": "low_noise", "medium": "medium_noise", "high": "high_noise"}  # names of scenarios
LEARNT = ("raw", "raw+action", "stack", "ekf", "enkf", "belief", "true")
FOR_PI = ("raw", "lowpass", "ekf", "enkf", "true")
FOR_STATES = ("lowpass", "kf", "ekf", "ukf", "enkf", "true")
CLASSICAL = {"pi": FOR_PI, "lqr": FOR_STATES, "one-step": FOR_STATES, "mpc": FOR_STATES}
BEST = "mpc"  # the best known controller: on the true state the end of "gap closed", and the one that is corrected
CORRECTING = {"ppo+mpc": "ppo", "sac+mpc": "sac"}  # policies that correct it, and their algorithm
OF_MEDIUM = {"sac": ("ekf", "true"), "ppo+mpc": ("true",), "sac+mpc": ("ekf", "true")}  # at medium noise only
VARIANT_NOISE = "medium"
WRONG = {"wrong model": "mismatch", "dead band": "deadband", "unknown flow": "ambient"}  # with the scenario
VARIANTS = (
    ("ekf", "untuned"),
    ("ekf", "tuned"),
    ("ekf", "wrong model"),
    ("ekf", "wrong model tuned"),
    ("enkf", "wrong model"),
    ("ekf", "dead band"),
    ("ekf", "unknown flow"),
)
TUNING_TRIALS = 60

# Of stored results.
RUNS = "runs"
STEPS_APART = 40_000  # training steps between points of a learning curve: an evaluation has 16 000 steps
EPISODES = "episodes"  # the source of variation that all figures share


class Comparison(NamedTuple):
    """The size of a comparison; the defaults are those of docs/policies.md."""

    noises: tuple[str, ...] = tuple(NOISES)
    observation_sets: tuple[str, ...] = LEARNT
    seeds: int = 5  # training seeds of each learnt policy
    steps: int | None = None  # training steps; None for the algorithm's default
    episodes: int = 200  # held-out episodes, the same for all
    variants: bool = True  # filters with other Q and R, and wrong models
    recurrent: bool = False  # PPO with an LSTM on raw measurements, which is slow


QUICK = Comparison(noises=("medium",), seeds=2, steps=8_192, episodes=16, variants=False)


class Run(NamedTuple):
    """One policy, trained with one seed."""

    noise: str
    kind: str  # an algorithm, one of `CORRECTING`, or a controller of `CLASSICAL`
    variant: str  # variant of the filter or of the situation; may be empty
    setup: TrainingConfiguration

    @property
    def label(self) -> str:
        """Observation set and variant."""
        return f"{self.setup.observe}, {self.variant}" if self.variant else self.setup.observe

    @property
    def name(self) -> str:
        """Name of its files."""
        words = [self.noise, self.kind, self.setup.observe, *self.variant.split(), f"seed{self.setup.seed}"]
        return "-".join(words).replace("+", "-and-")


def runs_of(comparison: Comparison) -> list[Run]:
    """All runs of a comparison; seed by seed, so that early results include each observation set."""
    variants = VARIANTS if comparison.variants else ()
    cases = [
        (noise, kind, observed, "")
        for noise in comparison.noises
        for kind in CLASSICAL
        for observed in CLASSICAL[kind]
    ]
    cases += [(VARIANT_NOISE, BEST, observed, variant) for observed, variant in variants]
    cases += [(VARIANT_NOISE, BEST, "true", variant) for variant in WRONG if variants and variant != "wrong model"]
    classical = [_run(comparison, *case) for case in cases]
    return classical + [
        _run(comparison, *case, seed) for seed in range(comparison.seeds) for case in _learnt(comparison)
    ]


def _learnt(comparison: Comparison) -> list[tuple[str, str, str, str]]:
    """Noise, kind, observation set and variant of the learnt policies."""
    cases = []
    for noise in comparison.noises:
        cases += [(noise, "ppo", observed, "") for observed in comparison.observation_sets]
        cases.append((noise, "ppo+mpc", "ekf", ""))
        if noise == VARIANT_NOISE:
            cases += [
                (noise, kind, observed, "")
                for kind, observation_sets in OF_MEDIUM.items()
                for observed in observation_sets
            ]
        if comparison.recurrent:
            cases.append((noise, "recurrent-ppo", "raw", ""))
    if comparison.variants:
        cases += [(VARIANT_NOISE, "ppo", observed, variant) for observed, variant in VARIANTS]
        cases += [(VARIANT_NOISE, "ppo+mpc", "ekf", variant) for variant in WRONG]
    return cases


def _run(comparison: Comparison, noise: str, kind: str, observed: str, variant: str = "", seed: int = 0) -> Run:
    scenario = _scenario(noise, variant)
    arguments: Mapping = {}
    if variant.endswith("untuned"):
        arguments = scenario.untuned
    elif variant.endswith("tuned"):
        arguments = _tuned(observed, noise, variant)
    algo = "ppo" if kind in CLASSICAL else CORRECTING.get(kind, kind)
    options = {"filter_arguments": plain_data(dict(arguments)), "controller": BEST if kind in CORRECTING else None}
    setup = make_configuration(TASK, scenario, observed, algo, steps=comparison.steps, seed=seed, **options)
    return Run(noise, kind, variant, setup)


def _scenario(noise: str, variant: str) -> Scenario:
    """The scenario of a noise level, with the fields that a variant takes from another one."""
    scenario = find_scenario(NOISES[noise])
    if (name := variant.removesuffix(" tuned")) in WRONG:
        other = find_scenario(WRONG[name])
        parts = {part: getattr(other, part) for part in ("parameter_factors", "amplifier", "flow")}
        return scenario.replace(**parts)
    return scenario


@cache
def _tuned(filter_name: str, noise: str, variant: str) -> Mapping:
    """Q and R of a study on the scenario, in which voltages are held at random levels."""
    quiet_optuna()
    scenario = _scenario(noise, variant)
    plan = Plan(filter_name, (scenario,))
    study = open_study("policies", plan, None)
    return run_study(study, plan, TUNING_TRIALS).or_interrupted().choice.model


OnRun = Callable[[Run, int, int], None]  # a finished run, number of finished runs, number of all runs


class Result(NamedTuple):
    """The result of a run."""

    run: Run
    scores: Scores
    curve: list[tuple[int, float]]  # steps and mean return of evaluations during training
    seconds: float


def run_comparison(
    comparison: Comparison,
    folder: str | Path,
    executor: Where = None,
    on_run: OnRun = lambda run, done, count: None,
) -> list[Result]:
    """Do all runs that the folder does not contain yet, and return all results.

    Ctrl-C ends it; a later call continues, trainings from their last checkpoints.

    Args:
        comparison: the comparison.
        folder: folder for a file of results and a folder of the training of each run.
        executor: as for `thruster_env.core.parallel.task_map`; on other hosts they must share the folder.
        on_run: called after each run.

    Raises:
        ValueError: if a file of results is damaged, or workers die again and again.
        KeyboardInterrupt: on Ctrl-C.
    """
    folder, runs = Path(folder), runs_of(comparison)
    results = {run.name: _read(folder, run, comparison.episodes) for run in runs}
    missing = [run for run in runs if results[run.name] is None]
    done = len(runs) - len(missing)
    with task_map(executor) as tasks:
        for index, _ in tasks(_do, [(run, folder, comparison.episodes) for run in missing]):
            run, done = missing[index], done + 1
            results[run.name] = _read(folder, run, comparison.episodes)
            on_run(run, done, len(runs))
    in_order = (results[run.name] for run in runs)
    return [result for result in in_order if result is not None]  # all are there now


def _do(run: Run, folder: Path, episodes: int) -> None:
    policy: Policy
    curve: list[tuple[int, float]] = []
    seconds = 0.0
    with one_thread():
        if run.kind in CLASSICAL:
            policy = classical_policy(run.kind, run.setup)
        else:
            points = max(1, run.setup.steps // STEPS_APART)
            folder_of_run = folder / RUNS / run.name
            trained = train(run.setup, folder_of_run, evaluations=points, checkpoints=4, tensorboard=False)
            curve, seconds = trained.curve, trained.seconds
            policy = load(trained.folder / FINAL, make_environments(run.setup, range(1)))
        scores = score(policy, run.setup, held_out_seeds(0, episodes))
    content = {
        "setup": json.loads(run.setup.as_json()),
        "episodes": episodes,
        "returns": scores.returns.tolist(),
        "parts": {name: [part.squares.tolist(), part.steps.tolist()] for name, part in scores.parts.items()},
        "curve": curve,
        "seconds": seconds,
    }
    write_whole(_file(folder, run), json.dumps(content))


def _read(folder: Path, run: Run, episodes: int) -> Result | None:
    """The result of a run; None unless there is one with exactly this training configuration."""
    path = _file(folder, run)
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["setup"] != json.loads(run.setup.as_json()) or content["episodes"] != episodes:
            return None
        parts = {name: Part(*map(np.array, pair)) for name, pair in content["parts"].items()}
        scores = Scores(np.array(content["returns"]), parts)
        return Result(run, scores, [tuple(point) for point in content["curve"]], content["seconds"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} must be a whole file of results, but cannot be read: {error}") from None


def _file(folder: Path, run: Run) -> Path:
    return folder / RUNS / f"{run.name}.json"


@dataclass(frozen=True)
class Figure:
    """A number, and by source of variation its values (n_k,) with one seed or episode left out each.

    So differences and ratios of figures are figures; `as_interval` gives the interval of any of them.
    """

    value: float
    without: Mapping[Hashable, np.ndarray] = field(default_factory=dict)

    def __sub__(self, other: Figure) -> Figure:
        """The difference of two figures."""
        return combined(lambda a, b: a - b, self, other)

    def __truediv__(self, other: Figure) -> Figure:
        """The ratio of two figures."""
        return combined(lambda a, b: a / b, self, other)


def combined(function: Callable, *figures: Figure) -> Figure:
    """A function of figures as a figure; a seed or episode is left out of all of them at the same time."""
    sources = dict.fromkeys(source for figure in figures for source in figure.without)
    return Figure(
        function(*(figure.value for figure in figures)),
        {k: function(*(figure.without.get(k, figure.value) for figure in figures)) for k in sources},
    )


def mean_figure(of_seeds: np.ndarray, without_episode: np.ndarray, source: Hashable) -> Figure:
    """The mean over training seeds of a quantity.

    Args:
        of_seeds: its values (S,), one a seed.
        without_episode: the same (E, S) with each of E episodes left out.
        source: name of the variation of these seeds; it cannot be estimated from one seed.
    """
    count, total = len(of_seeds), of_seeds.sum()
    without: dict[Hashable, np.ndarray] = {EPISODES: without_episode.mean(axis=1)}
    if count > 1:
        without[source] = (total - of_seeds) / (count - 1)
    return Figure(float(total / count), without)


def typical_return(results: Sequence[Result]) -> Figure:
    """Mean over seeds and episodes of the return of one policy."""
    returns = np.stack([result.scores.returns for result in results], axis=1)
    return mean_figure(returns.mean(axis=0), _left_out(returns) / max(len(returns) - 1, 1), _source(results))


def typical_error(results: Sequence[Result], part: str) -> Figure:
    """Mean over seeds of the pooled thrust error in a part of `Scores`, RMS [N]; NaN where no step counts."""
    parts = [result.scores.parts[part] for result in results]
    squares, steps = (np.stack(columns, axis=1) for columns in zip(*parts, strict=True))
    with np.errstate(invalid="ignore"):
        of_seeds = np.sqrt(squares.sum(axis=0) / steps.sum(axis=0))
        # By rounding a sum of squares that should be zero may be negative.
        without_episode = np.sqrt(np.maximum(_left_out(squares), 0) / _left_out(steps))
        return mean_figure(of_seeds, without_episode, _source(results))


def as_interval(figure: Figure) -> Interval:
    """The figure with its 95 % interval, by the jackknife.

        v_k = (n_k - 1)/n_k sum_i (f_(i) - mean f_(i))^2,    f_(i) the figure without its i-th seed or episode
        f -+ t sqrt(sum_k v_k),    Student's t of (sum v_k)^2/sum (v_k^2/(n_k - 1)) degrees of freedom

    for sources of variation k. For one mean it is Student's interval, for a difference Welch's. Episodes are one
    source, because they are the same for all policies; the training seeds of each policy are a separate source,
    because policies are trained independently. (The variation of one policy in one episode is in both sources,
    which is conservative.) With five seeds it covers 95 %, where the middle 95 % of bootstrap resamples cover less
    than 90 %; a test simulates both.

    Sources: B. Efron, C. Stein (1981), "The jackknife estimate of variance", Annals of Statistics 9(3), 586-596;
    B. L. Welch (1947), "The generalization of Student's problem when several different population variances are
    involved", Biometrika 34, 28-35.
    """
    variances, freedoms = [], []
    for values in figure.without.values():
        if len(values) > 1:
            variances.append((len(values) - 1) * values.var())
            freedoms.append(len(values) - 1)
    variance = sum(variances)
    if not variance > 0:
        return Interval(figure.value, figure.value, figure.value)
    freedom = variance**2 / sum(v**2 / n for v, n in zip(variances, freedoms, strict=True))
    half = student.ppf(0.975, freedom) * np.sqrt(variance)
    return Interval(float(figure.value), float(figure.value - half), float(figure.value + half))


def _left_out(values: np.ndarray) -> np.ndarray:
    """Sums over episodes of values (E, S) with each of them left out, (E, S)."""
    return values.sum(axis=0) - values


def _source(results: Sequence[Result]) -> Hashable:
    run = results[0].run
    return run.noise, run.kind, run.label
