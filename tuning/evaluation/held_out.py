"""Held-out evaluation: a choice and its baselines on seeds that no trial saw, with the bound on these seeds.

Files and studies store evaluations as plain numbers with a digest of the inputs: the choice, the problems and the
versions of all packages. A stored evaluation is used only if its digest still matches. The digest does not prove
who wrote it; `tuning.evaluation.tuned` recomputes held-out metrics.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import Interval, mean_interval
from filters.consistency.time_constants import TimeConstants
from filters.starts import Restarts
from thruster_env.core.angles import is_angle
from thruster_env.core.checks import with_progress
from thruster_env.core.parallel import IN_PROCESS, TaskMap
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import tangent_of
from tuning.evaluation.baselines import (
    BY_IMPORTANCE,
    GIVEN,
    NOISE,
    ORACLE,
    RULE,
    SCALED,
    TUNED,
    Scaled,
    baseline_size,
    baselines,
    log_densities,
    rule_label,
    rule_of_thumb,
    same_filter,
    scaled_default,
    scaled_rule,
)
from tuning.evaluation.evaluate import NOTHING, Evaluation, evaluate, likelihood_gain, score_ratio
from tuning.evaluation.residuals import UnevenNis, uneven_nis
from tuning.evaluation.runs import outputs_of
from tuning.evaluation.sizes import SizeRow
from tuning.problems.check import data_of
from tuning.problems.data import Data
from tuning.problems.problem import Problem
from tuning.search.parameters import size_ladder
from tuning.search.plan import HELD_OUT_SEEDS, SIZE_SEEDS, TRAINING_SEEDS, Plan
from tuning.search.space import Choice, time_constants_on, with_oracle_and_advice

PACKAGES = ("thruster-env", "optuna", "numpy", "numba", "gymnasium")
ROLES = ("untuned", "tuned", "true", "scaled", "given", "noise")  # evaluations of a `Comparison`


class Comparison(NamedTuple):
    """A choice and its baselines on the same held-out seeds, and the bound on these."""

    untuned: Evaluation  # the rule of thumb
    tuned: Evaluation
    true: Evaluation | None  # the oracle; None where the plant's Q and R are unknown
    bound: np.ndarray  # (n,) bound on the standard error of each state
    seeds: range
    scaled: Evaluation | None = None  # the scaled default; None where there is none
    default: Scaled | None = None  # its factor, or the reason why there is none; None where it was not requested
    stored_ratios: Mapping[str, Interval] | None = (
        None  # given where evaluations are summaries without single runs
    )
    stored_gains: Mapping[str, Interval] | None = None
    rule: str = RULE  # GIVEN where the rule of thumb is what was given, and so no row of its own: `rule_label`
    given: Evaluation | None = None  # what the model came with; None where nobody gave anything
    noise: Evaluation | None = None  # noise estimation; None where there is none
    lacks_ranges: bool = False  # whether the rule of thumb has the model's own Q: `Problem.lacks_ranges`
    over_regression: Interval = NOTHING  # without truth: `gain_over_regression` of the tuned filter

    @property
    def evaluations(self) -> dict[str, Evaluation]:
        """All evaluations by the names in tables, in the order of the rows."""
        by_name = {GIVEN: self.given, RULE: self.untuned, SCALED: self.scaled, NOISE: self.noise}
        by_name |= {TUNED: self.tuned, ORACLE: self.true}
        if self.rule == GIVEN:
            del by_name[RULE]
        return {name: evaluation for name, evaluation in by_name.items() if evaluation is not None}

    @property
    def baselines(self) -> tuple[str, ...]:
        """Names of the existing baselines, the most important one first, those with the plant's Q and R last."""
        names = [name for name in BY_IMPORTANCE if name in self.evaluations]
        return tuple(sorted(names, key=lambda name: name == ORACLE or (name == GIVEN and self.given_is_oracle)))

    @property
    def given_is_oracle(self) -> bool:
        """Whether the model came with the plant's own Q and R, which tuning does not compete with."""
        if self.given is None or self.true is None or self.rule == GIVEN:
            return False
        return (self.given.score, self.given.nis) == (self.true.score, self.true.nis)

    @property
    def ratios(self) -> dict[str, Interval]:
        """Score of the tuned filter over that of each baseline, paired, the most important baseline first."""
        if self.stored_ratios is not None:
            return dict(self.stored_ratios)
        evaluations = self.evaluations
        return {name: score_ratio(self.tuned, evaluations[name]) for name in self.baselines}

    @property
    def likelihood_gains(self) -> dict[str, Interval]:
        """Log-likelihood of a run of the tuned filter minus that of each baseline; it needs no truth."""
        if self.stored_gains is not None:
            return dict(self.stored_gains)
        evaluations = self.evaluations
        return {name: likelihood_gain(self.tuned, evaluations[name]) for name in self.baselines}


def evaluate_held_out(
    choice: Choice, scenario: Problem, seed: int, count: int = HELD_OUT_SEEDS, tasks: TaskMap = IN_PROCESS
) -> Comparison:
    """A choice and its baselines on seeds that the study never saw, with the bound on these seeds.

    Baselines of an ensemble filter have as many members as the choice, or more: `baseline_size`.

    Args:
        choice: of a study.
        scenario: the problem.
        seed: of the study; its training seeds scale the scaled default.
        count: number of held-out seeds; a problem of logs has a fixed number, and ignores it.
        tasks: what runs each of the filters.
    """
    seeds = scenario.held_out_seeds(seed, count)
    data = data_of(scenario, seeds)
    size = baseline_size(choice)
    default = scaled_default(choice.name, scenario, seed, size)
    known = baselines(choice.name, scenario, seed, default, size)
    choices = {
        "untuned": known.get(RULE, known.get(GIVEN)),  # which may be the same
        "tuned": choice,
        "true": known.get(ORACLE),
        "scaled": known.get(SCALED),
        "given": known.get(GIVEN),
        "noise": known.get(NOISE),
    }
    different: list[Choice] = []  # of which baselines may be the same filter
    for candidate in choices.values():
        if candidate is not None and _index_in(different, candidate) < 0:
            different.append(candidate)
    runs = [(candidate.filter(scenario), data, scenario.scale) for candidate in different]
    with_bar = zip(with_progress("filters on held-out seeds", runs), tasks(evaluate, runs), strict=True)
    by_index = dict(result for _, result in with_bar)
    evaluations = {
        role: None if candidate is None else by_index[_index_in(different, candidate)]
        for role, candidate in choices.items()
    }
    untuned, tuned = evaluations.pop("untuned"), evaluations.pop("tuned")
    assert untuned is not None and tuned is not None  # these two choices are never None
    constants = time_constants_on(choice.filter(scenario), scenario, seed)
    if constants is not None:
        constants = with_oracle_and_advice(constants, choice, scenario, seed)
    uneven = uneven_nis(choice.filter(scenario), scenario, seed)
    tuned = tuned._replace(time_constants=constants, uneven=uneven)
    bound, rule, lacks = scenario.bound(data), rule_label(scenario), scenario.lacks_ranges
    over_regression = NOTHING
    if data.states is None:
        training = data_of(scenario, scenario.training_seeds(seed, TRAINING_SEEDS))
        over_regression = gain_over_regression(scenario.model(), tuned, training, data)
    return Comparison(
        untuned,
        tuned,
        evaluations["true"],
        bound,
        seeds,
        evaluations["scaled"],
        default,
        rule=rule,
        given=evaluations["given"],
        noise=evaluations["noise"],
        lacks_ranges=lacks,
        over_regression=over_regression,
    )


def _index_in(choices: Sequence[Choice], choice: Choice) -> int:
    """The index of the same filter among choices; -1 if it is not among them."""
    return next((index for index, before in enumerate(choices) if same_filter(choice, before)), -1)


def versions() -> dict[str, str]:
    """Installed versions of the packages that a tuned file depends on."""
    return {name: _version(name) for name in PACKAGES}


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def summary(evaluation: Evaluation) -> dict:
    """The results of an evaluation as plain numbers for JSON, None if there is no value."""
    return {
        "rmse": [numbers(value) for value in evaluation.rmse],
        "start_up_rmse": _plain(evaluation.start_up_rmse),
        **{_key(evaluation.outputs[symbol]): numbers(rmse) for symbol, rmse in evaluation.output_rmse.items()},
        "score": numbers(evaluation.score),
        "nees": numbers(evaluation.nees),
        "state_nees": _plain(evaluation.state_nees),
        "nis": numbers(evaluation.nis),
        "log_score": numbers(evaluation.log_score),
        "log_likelihood": None if math.isnan(evaluation.log_likelihood) else evaluation.log_likelihood,
        "divergences": evaluation.divergences,
        **({"time_constants": _time_constants(evaluation.time_constants)} if evaluation.time_constants else {}),
        **({"restarts": evaluation.restarts._asdict()} if evaluation.restarts else {}),
        **({"uneven": evaluation.uneven._asdict()} if evaluation.uneven else {}),
    }


def summarised(
    data: Mapping, problem: Problem, expected_nis: float | None = None, median_nees: float | None = None
) -> Evaluation:
    """An evaluation from a `summary`, without single runs: it has the arrays of one run.

    It allows no intervals and no paired comparison.

    Raises:
        KeyError, TypeError, ValueError: if the data are not a summary.
    """
    model = problem.model()
    rmse = tuple(map(as_interval, data["rmse"]))
    outputs = {symbol: quantity for symbol, quantity in outputs_of(model).items() if _key(quantity) in data}
    likelihood = _number(data["log_likelihood"])
    return Evaluation(
        states=tangent_of(model)[: len(rmse)],
        outputs=outputs,
        rmse=rmse,
        start_up_rmse=np.array([_number(part) for part in data["start_up_rmse"]]),
        score=as_interval(data["score"]),
        output_rmse={symbol: as_interval(data[_key(quantity)]) for symbol, quantity in outputs.items()},
        nees=as_interval(data["nees"]),
        state_nees=np.array([_number(part) for part in data.get("state_nees") or [None] * len(rmse)]),
        median_nees=_number(median_nees),
        nis=as_interval(data["nis"]),
        expected_nis=_number(expected_nis),
        channels=model.m,
        log_likelihood=likelihood,
        log_likelihoods=np.array([likelihood]),
        divergences=int(data["divergences"]),
        restarts=_restarts(data.get("restarts")),
        mean_squares=np.array([[value.value**2 for value in rmse]]),
        log_score=as_interval(data.get("log_score")),
        time_constants=_as_time_constants(data.get("time_constants")),
        uneven=_uneven(data.get("uneven")),
        scale=np.array([math.nan] * len(rmse) if problem.scale is None else problem.scale, dtype=np.float64),
    )


def numbers(value: Interval) -> list[float] | None:
    """An interval as plain numbers, None if there is none."""
    return None if math.isnan(value.value) else list(value)


def as_interval(data) -> Interval:
    """An interval from plain numbers."""
    return NOTHING if data is None else Interval(*map(float, data))


def _plain(values: np.ndarray | None) -> list[float | None]:
    """An array as plain numbers, None in place of NaN."""
    return [] if values is None else [None if math.isnan(part) else part for part in values.tolist()]


def _restarts(data: Mapping | None) -> Restarts | None:
    """Restarts from plain numbers; None of a file that says nothing of them."""
    if data is None:
        return None
    counts = {name: int(data[name]) for name in ("times", "runs", "of_runs", "run", "step")}
    return Restarts(**counts, states=tuple(map(str, data["states"])), cause=str(data["cause"]))


def _uneven(data: Mapping | None) -> UnevenNis | None:
    """A mean NIS that a few blocks carry from plain numbers; None of a file that says nothing of it."""
    if data is None:
        return None
    return UnevenNis(**{**data, "spans": tuple(map(str, data["spans"]))})


def _time_constants(constants: TimeConstants) -> dict:
    """Time constants as plain numbers, None in place of an infinite one."""
    steps = [part if math.isfinite(part) else None for part in (*constants.steps, constants.uptake)]
    known = {name: value for name, value in constants._asdict().items() if value is not None}
    lists = {"steps": steps[:-1], "unobservable": list(constants.unobservable)}
    if constants.oracle is not None:
        lists["oracle"] = [part if math.isfinite(part) else None for part in constants.oracle]
    return {**known, **lists, "uptake": steps[-1]}


def _as_time_constants(data: Mapping | None) -> TimeConstants | None:
    """Time constants from plain numbers; None of a file that says nothing of them."""
    if data is None:
        return None
    lists = (data["steps"], (data["uptake"], *data.get("oracle", ())))
    steps, (uptake, *oracle) = (
        tuple(math.inf if part is None else float(part) for part in parts) for parts in lists
    )
    return TimeConstants(
        steps,
        int(data["slowest"]),
        uptake,
        tuple(map(int, data["unobservable"])),
        int(data["length"]),
        (oracle[0], oracle[1]) if oracle else None,
        data.get("advised"),
    )


def _number(value) -> float:
    return math.nan if value is None else float(value)


def _key(output: Quantity) -> str:
    """The key of a derived output's RMSE in a file: "thrust_rmse" for the thrust."""
    return f"{output.name.replace(' ', '_')}_rmse"


def sizes_as_data(rows: Sequence[SizeRow], choice: Choice, plan: Plan) -> dict:
    """The table of ensemble sizes of a choice as plain data, with a digest of its inputs."""
    table = [
        {
            "N": row.size,
            "seeds": row.seeds,
            "ratio": numbers(row.ratio),
            "nis_violation": row.outside,
            "metrics": summary(row.evaluation),
        }
        for row in rows
    ]
    return {"digest": _digest_of_sizes(choice, plan), "rows": table}


def stored_sizes(data, choice: Choice, plan: Plan) -> list[SizeRow] | None:
    """The stored table of ensemble sizes if it belongs to this choice, otherwise None.

    Args:
        data: the result of `sizes_as_data`, or anything else.
        choice: its size must be in the table.
        plan: the plan of the study.
    """
    if not isinstance(data, Mapping) or data.get("digest") != _digest_of_sizes(choice, plan):
        return None
    try:
        rows = [
            SizeRow(
                int(row["N"]),
                summarised(row["metrics"], plan.scenarios[0]),
                as_interval(row["ratio"]),
                float(row["nis_violation"]),
                int(row["seeds"]),
            )
            for row in data["rows"]
        ]
    except (KeyError, TypeError, ValueError):
        return None
    return rows if choice.numbers["ensemble_size"] in [row.size for row in rows] else None


def _digest_of_sizes(choice: Choice, plan: Plan) -> str:
    of_filter = {key: value for key, value in choice.numbers.items() if key != "ensemble_size"}
    parameters = {
        parameter.name: choice.model.get(parameter.name) for parameter in plan.scenarios[0].parameters or ()
    }
    model = plan.scenarios[0].model(**choice.model)  # a file may contain more of it than a trial
    noise = [model.process_noise_cov.tolist(), model.measurement_noise_cov.tolist(), model.prior_cov.tolist()]
    of_problems = [problem.digest for problem in plan.scenarios], plan.consistent, plan.budget, plan.seed
    seeds = SIZE_SEEDS, TRAINING_SEEDS, size_ladder(choice.name)
    text = json.dumps([choice.name, parameters, noise, of_filter, of_problems, seeds, versions()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def stored_comparison(content: Mapping, choice: Choice, problem: Problem) -> Comparison | None:
    """The held-out comparison on a problem that a tuned file stores; None if it has to be recomputed.

    It is recomputed if the file lacks it, or was made with other versions of packages.

    Args:
        content: content of the tuned file.
        choice: the file's choice.
        problem: one of the file's problems, with the file's digest.
    """
    if content.get("made_with") != versions():
        return None
    try:
        held_out, more = content["held_out"][problem.name], content["comparisons"][problem.name]
        by_role = {role: _summarised(role, held_out, more, problem) for role in ROLES}
        untuned, tuned = by_role["untuned"], by_role["tuned"]
        if untuned is None or tuned is None:
            return None
        scaling, reason = held_out["scaled_default"], str(more["no_scaled_default"])
        default = Scaled(None, None, None, reason)
        if scaling["factor"] is not None:
            factor, nis = float(scaling["factor"]), float(scaling["mean_nis"])
            scaled = scaled_rule(rule_of_thumb(choice.name, problem), problem, factor)
            size = baseline_size(choice)
            default = Scaled(scaled if size is None else scaled.with_size(size), factor, nis)
        first, beyond = map(int, held_out["seeds"])
        return Comparison(
            untuned,
            tuned,
            by_role["true"],
            scaled=by_role["scaled"],
            bound=np.array([math.nan if part is None else float(part) for part in held_out["bound"]]),
            seeds=range(first, beyond),
            default=default,
            stored_ratios={str(name): as_interval(ratio) for name, ratio in more["score_ratios"].items()},
            stored_gains={str(name): as_interval(gain) for name, gain in more["likelihood_gains"].items()},
            rule=rule_label(problem),
            given=by_role["given"],
            noise=by_role["noise"],
            lacks_ranges=problem.lacks_ranges,
            over_regression=as_interval(more.get("over_regression")),
        )
    except (AttributeError, KeyError, TypeError, ValueError):
        return None


def _summarised(role: str, held_out: Mapping, more: Mapping, problem: Problem) -> Evaluation | None:
    if held_out.get(role) is None:  # also of a file that is older than the role
        return None
    return summarised(held_out[role], problem, more["expected_nis"], more["median_nees"][role])


def gain_over_regression(model: StateSpaceModel, tuned: Evaluation, training: Data, data: Data) -> Interval:
    """Log-likelihood of a measurement that a filter predicts, minus that of a regression, with paired interval.

    Args:
        model: with the channels; angles are unwrapped.
        tuned: the filter on `data`.
        training: runs that the regression is fitted to.
        data: runs on which both are compared.

    Returns:
        The mean over all scored measurements; NaN for a filter without a covariance, for measured
        rotations, or if there are too few rows.
    """
    if model.measured_turns:
        return NOTHING
    angles = [is_angle(i, model.any_shape.measurement_angles) for i in range(model.m)]
    densities = log_densities(training, data, np.array(angles))
    scored = np.where(data.scored[..., None], densities, np.nan)
    counts = np.isfinite(scored).sum(axis=(1, 2))
    if not counts.all() or np.isnan(tuned.log_likelihoods).any():
        return NOTHING
    return mean_interval((tuned.log_likelihoods - np.nansum(scored, axis=(1, 2))) / counts.mean())
