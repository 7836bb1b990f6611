"""The tuned file: one JSON file with a filter's parameters, their origin and their held-out metrics.

`tuning.verify` recomputes the metrics on the file's own seeds.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from filters.estimators.foreign import is_foreign, label_of
from filters.monitoring import THRESHOLDS, Monitor, monitor_for
from filters.tuned_file import (
    AUGMENTED,
    FACTORS,
    FILE_FORMAT,
    FILE_VERSION,
    NOISE,
    PRIOR,
    check_same_quantities,
    compared,
    made_with,
    model_data,
    read_tuned_file,
    sealed,
)
from thruster_env.core.checks import at_least, covariance, positive, short_repr
from thruster_env.core.files import write_whole
from thruster_env.core.modules import is_code
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import readings
from tuning.evaluation.evaluate import Evaluation
from tuning.evaluation.held_out import ROLES, Comparison, numbers, sizes_as_data, summary, versions
from tuning.problems.assumed import augmented, name_and_unknown, suited
from tuning.problems.check import is_older
from tuning.problems.find import built_in, find_given, find_problem, scenario_of
from tuning.problems.problem import Problem
from tuning.search.plan import NIS_BAND, Plan
from tuning.search.space import Choice
from tuning.search.study import StudyResult
from tuning.search.validation import as_data

SAME_NOISE = 1e-6  # relative difference of two covariances, above which they are not the same


def write_tuned(
    path: str | Path,
    plan: Plan,
    result: StudyResult,
    comparisons: Sequence[Comparison],
    study_name: str,
    method: str | None = None,
) -> None:
    """Write a tuned file with `tuned_content`, completely or not at all; ValueError if it cannot be written."""
    content = tuned_content(plan, result, comparisons, study_name, method)
    write_whole(Path(path), json.dumps(sealed(content), indent=2) + "\n")


def comparison_as_data(comparison: Comparison) -> dict:
    """The data of a comparison that a report needs besides the metrics in a tuned file."""
    by_role = {role: getattr(comparison, role) for role in ROLES}
    return {
        "expected_nis": _plain_numbers(comparison.tuned.expected_nis),
        "median_nees": {
            role: evaluation and _plain_numbers(evaluation.median_nees) for role, evaluation in by_role.items()
        },
        "score_ratios": {name: numbers(ratio) for name, ratio in comparison.ratios.items()},
        "likelihood_gains": {name: numbers(gain) for name, gain in comparison.likelihood_gains.items()},
        "over_regression": numbers(comparison.over_regression),
        "no_scaled_default": "" if comparison.default is None else comparison.default.reason,
    }


def _plain_numbers(value: float) -> float | None:
    return None if math.isnan(value) else value


def tuned_content(
    plan: Plan, result: StudyResult, comparisons: Sequence[Comparison], study_name: str, method: str | None = None
) -> dict[str, Any]:
    """The content of a tuned file.

    Args:
        plan: the plan of the study.
        result: its result, with the choice.
        comparisons: held-out evaluations, one for each scenario.
        study_name: name of the study.
        method: name of the method that made the choice, or "by hand"; the plan's sampler if None.

    Raises:
        ValueError: if the filter is an estimator, which is code.
    """
    choice, problem = result.choice, plan.scenarios[0]
    check_keepable(choice.name)
    model = problem.model(**choice.model)
    pairs = list(zip(plan.scenarios, comparisons, strict=True))
    return {
        "format": FILE_FORMAT,
        "version": FILE_VERSION,
        "made_with": versions(),
        "filter": {
            "name": choice.name,
            "numbers": choice.numbers,
            "model": {**_noise_of(model), **choice.model, **problem.held},
        },
        "problem": problem.name,
        "digest": problem.digest,
        "model": model_data(model, problem.dt),
        "plant": problem.plant_data,
        "problems": {
            scenario.name: _problem_as_data(scenario)
            for scenario in plan.scenarios
            if scenario.name not in built_in()
        },
        "study": {
            "name": study_name,
            **plan.identity,
            "method": plan.sampler if method is None else method,
            "trials": result.finished,
            "best_training_value": result.best_value if method in (None, plan.sampler) else None,
            "microseconds_a_step": result.microseconds,
            **consistency(result),
        },
        "held_out": {problem.name: metrics(comparison) for problem, comparison in pairs},
        "comparisons": {problem.name: comparison_as_data(comparison) for problem, comparison in pairs},
        "monitor": _monitor_of(choice, plan),
        "choice": as_data(result.validation),
        "ensemble_sizes": sizes_as_data(result.sizes, result.sized or choice, plan) if result.sizes else None,
    }


def monitor_data(monitor: Monitor, channels: int) -> dict[str, Any]:
    """A monitor's attributes, and its thresholds by test, as JSON can hold them.

    Thresholds of `outlier` are those of one channel, two, ... that are there; of `variance` the least and the
    largest sum of a block.
    """
    _, cusum, glr, low, high, _, stuck, missing, *outliers = monitor.limits(channels).tolist()
    thresholds = {"outlier": outliers, "cusum": cusum, "glr": glr, "variance": [low, high]}
    return {**monitor.as_mapping(), THRESHOLDS: {**thresholds, "stuck": stuck, "missing": missing}}


def _monitor_of(choice: Choice, plan: Plan) -> dict | None:
    """The monitor of a filter with a covariance, whose counts follow from the training runs; else None."""
    filter_ = choice.filter(plan.scenarios[0])
    if not filter_.has_covariance:
        return None
    measurements = readings(plan.training_data()[0].seen.measurements, filter_.model.measured_turns)
    return monitor_data(monitor_for(measurements), measurements.shape[-1])


def check_keepable(name) -> None:
    """Raise ValueError for an estimator, which is code: reading a tuned file must not import what it names."""
    if is_foreign(name):
        raise ValueError(
            f"a tuned file must be of a filter of filters.FILTERS, but got {label_of(name)!r}: "
            "tune an estimator by tuning.tune, and store its parameters yourself"
        )


def _noise_of(model: StateSpaceModel) -> dict:
    """Q and R as data, for readers that do not know the parameters that they follow from."""
    return {name: getattr(model, name).tolist() for name in NOISE}


def _problem_as_data(problem: Problem) -> dict:
    """A problem as a tuned file stores it: its digest and, unless it is code, its full content."""
    return {"digest": problem.digest, "content": problem.as_mapping()}


def problem_in(content: Mapping, name, path: str | Path, problems: Sequence[Problem] = ()) -> Problem:
    """A problem of a tuned file: built in, stored in the file, or given by the caller.

    Names in a file are never imported: a problem that is code has to be given. A file of version 2 has only the
    path of a scenario file, which is then read.

    Args:
        content: content of the tuned file, from `read_tuned_file`.
        name: name of the problem.
        path: path of the tuned file, for errors.
        problems: those of the caller, matched by name or digest.

    Raises:
        ValueError: if there is no such problem, the stored content is damaged, or the given problem is another
            one.
    """
    stored = content["problems"].get(name) if isinstance(name, str) and name not in built_in() else None
    digest = stored.get("digest") if isinstance(stored, Mapping) else None
    problems = problems if digest is not None else ()
    same = next((problem for problem in problems if problem.digest == digest), None)
    if same is not None:
        return same
    for problem in problems:
        if problem.name == name and is_older(digest, problem.digest):
            warnings.warn(
                f"whether {name} is the problem that {path} was tuned on cannot be told from its digest, which is "
                f"that of an older version; {path} was made with {made_with(content)}",
                stacklevel=3,
            )
            return problem
        if problem.name == name:
            raise ValueError(
                f"the problem of a tuned file must be the one it was tuned on, {name} of digest {digest}, but "
                f"here it has the digest {problem.digest}; {path} was made with {made_with(content)}: has "
                "that changed?"
            )
    plain, unknown = name_and_unknown(name) if digest is not None else (name, {})
    mapping = stored.get("content") if isinstance(stored, Mapping) else stored
    if unknown and isinstance(mapping, Mapping) and "of" in mapping:
        return augmented(
            problem_in({"problem": plain, "problems": {plain: mapping.get("of")}}, plain, path, problems), unknown
        )
    if isinstance(mapping, Mapping) and "logs" in mapping:
        raise ValueError(
            f"a problem of logs must be given, but {path} only names the logs of {name}: the commands evaluate, "
            "verify and report read them again"
        )
    if mapping is None:
        if problems and isinstance(name, str) and is_code(name):
            names = ", ".join(problem.name for problem in problems)
            raise ValueError(
                f"the problem of a tuned file must be the one it was tuned on, {name}, but got {names}: "
                f"use --problem {name} for {path}, if you trust it"
            )
        return find_given(name, (), path)
    return scenario_of(mapping, name, path)


def _warn_of_changes(content: Mapping, path: str | Path) -> None:
    """Warn of each scenario file that has changed since the tuned file stored its content."""
    for name in content["problems"]:
        if not name.endswith(".toml") or not Path(name).is_file():
            continue
        then = problem_in(content, name, path).digest
        try:
            now = find_problem(name).digest
        except ValueError:
            now = "none that can be read"
        if now != then:
            warnings.warn(
                f"{name} is not the scenario that {path} was tuned on (digest {then} then, {now} now): "
                "the stored scenario is used here",
                stacklevel=3,
            )


def read_tuned(path: str | Path, problems: Sequence[Problem] = ()) -> tuple[Choice, Problem, int]:
    """Choice, problem and study seed of a tuned file; ValueError for a damaged one.

    A scenario from a file is as it was when the filter was tuned; a warning says if the file has changed since.

    Args:
        path: path of the file.
        problems: the problems it was tuned on, if these are code, since the file only names them.
    """
    content = read_tuned_file(path)
    try:
        seed = at_least("seed", content["study"]["seed"], 0)
        problem = problem_in(content, content["problem"], path, problems)
        _warn_of_changes(content, path)
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"a tuned file must have all its entries, but in {path} this is missing or no such value: {error}"
        ) from None
    arguments = content["filter"]["model"]
    held_values = {name: arguments.get(name, {}) for name in {*problem.held, *(set(arguments) & {FACTORS})}}
    if held_values != dict(problem.held):
        raise ValueError(
            f"the model of a tuned file must be that of its scenario, {problem.held.get(FACTORS, {})}, "
            f"but {path} has {short_repr(arguments)}"
        )
    known = {*NOISE, PRIOR, *problem.held, *(parameter.name for parameter in problem.parameters or ())}
    if set(arguments) - known:
        raise ValueError(
            f"arguments of the model in a tuned file must be among {', '.join(sorted(known))}, "
            f"but {path} has {', '.join(sorted(set(arguments) - known))}"
        )
    return _choice(content, problem), problem, seed


def read_choice(path: str | Path, problem: Problem) -> Choice:
    """The choice of a tuned file for a problem of the same plant, or states, inputs and sensors, `suited_to` it.

    Raises:
        ValueError: if the file is damaged, or for another plant: another thruster, dt or sensor.
    """
    content, problem = read_tuned_file(path), suited_to(path, problem)
    with compared(content, path):
        problem.check_tuned_for(content.get("plant"), path)
        if "model" in content:
            check_same_quantities(content["model"], problem.model(), problem.dt, path)
    return _choice(content, problem)


def suited_to(path: str | Path, problem: Problem) -> Problem:
    """The problem as the filter of a tuned file assumes it: with the constants as states that the file has."""
    return suited(problem, read_tuned_file(path)["filter"]["model"].get(AUGMENTED, {}))


def _choice(content: Mapping, problem: Problem) -> Choice:
    """The choice of a tuned file's content: the problem's parameters if it has any, else Q and R.

    Both, where the file has a Q and R that the parameters do not give, as baselines have.
    """
    entry, model = content["filter"], problem.model()
    names = [parameter.name for parameter in problem.parameters or ()]
    chosen = {name: entry["model"][name] for name in names if name in entry["model"]}
    if not names or len(chosen) < len(names) or not _gives_noise(problem.model(**chosen), entry["model"]):
        chosen = chosen if len(chosen) == len(names) else {}
        chosen |= {
            name: _noise(name, entry["model"][name], size, positive_definite=name == "measurement_noise_cov")
            for name, size in zip(NOISE, (model.t, model.m), strict=True)
        }
    if PRIOR in entry["model"]:
        chosen[PRIOR] = positive(PRIOR, entry["model"][PRIOR])
    choice = Choice(entry["name"], chosen, dict(entry["numbers"]))
    choice.filter(problem)  # a clear error for parameters that the filter does not have
    return choice


def _gives_noise(model: StateSpaceModel, entry: Mapping) -> bool:
    """Whether a model has the Q and R of a file, as far as that tells them."""
    for name in NOISE:
        if name in entry:
            cov, stored = getattr(model, name), np.asarray(entry[name], dtype=np.float64)
            stored = stored if stored.ndim == 2 else np.diag(np.atleast_1d(stored))
            if stored.shape != cov.shape or not np.allclose(cov, stored, rtol=SAME_NOISE, atol=0.0):
                return False
    return True


def _noise(name: str, value, size: int, *, positive_definite: bool):
    """A covariance as a choice stores it: one variance, several, or the rows of a matrix."""
    if np.ndim(value) == 0:
        return positive(name, value)
    matrix = covariance(name, value, size, positive_definite=positive_definite)
    return tuple(map(tuple, matrix.tolist())) if np.ndim(value) == 2 else tuple(np.diag(matrix).tolist())


def metrics(comparison: Comparison) -> dict:
    """The metrics of a held-out comparison as plain numbers for JSON."""
    return {
        "seeds": [comparison.seeds.start, comparison.seeds.stop],
        "bound": [None if math.isnan(part) else part for part in comparison.bound.tolist()],
        **{name: _summary_of(getattr(comparison, name)) for name in ROLES},
        "scaled_default": scaling(comparison),
    }


def _summary_of(evaluation: Evaluation | None) -> dict | None:
    return None if evaluation is None else summary(evaluation)


def scaling(comparison: Comparison) -> dict:
    """The scaled default's factor on Q and its mean NIS on the training runs, or None."""
    default = comparison.default
    return {"factor": default and default.factor, "mean_nis": default and default.nis}


def consistency(result: StudyResult) -> dict:
    """Whether any trial of a study was consistent, and the mean NIS of its choice, as plain numbers for JSON."""
    nis = [ratio if math.isfinite(ratio) else None for ratio in result.nis]
    return {"any_trial_consistent": result.consistent, "mean_nis": nis, "nis_band": list(NIS_BAND)}
