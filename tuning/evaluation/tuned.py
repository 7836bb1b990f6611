"""The tuned file: one JSON file that carries a filter's numbers, where they come from and what they achieve."""

from __future__ import annotations

import importlib.metadata
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from filters.consistency.intervals import Interval
from filters.tuned_file import FILE_FORMAT, FILE_VERSION, read_tuned_file, sealed
from numerics.checks import at_least, covariance, positive, shown
from numerics.files import write_whole
from plants.quantities import Quantity
from thruster_env.plant_data import check_same_plant, plant_data
from tuning.evaluation.evaluate import Evaluation
from tuning.evaluation.held_out import Comparison
from tuning.problems.find import find_problem
from tuning.problems.problem import Problem
from tuning.search.objectives import NIS_BAND
from tuning.search.plan import Plan
from tuning.search.space import Choice
from tuning.search.study import StudyResult
from tuning.thruster.files import scenario_of
from tuning.thruster.scenario import frozen
from tuning.thruster.scenarios import SCENARIOS

PACKAGES = ("thruster-env", "optuna", "numpy", "numba", "gymnasium")


def write_tuned(
    path: str | Path,
    plan: Plan,
    result: StudyResult,
    proofs: Sequence[Comparison],
    study_name: str,
    method: str = "optuna",
) -> None:
    """Write a tuned file whole or not at all.

    Args:
        path: of the file.
        plan: what the study was for.
        result: the choice, and where it comes from.
        proofs: on held-out seeds, one for each scenario.
        study_name: of the study.
        method: what made the choice, "optuna" or "gradient".

    Raises:
        ValueError: if the folder cannot be written.
    """
    choice, scenario = result.choice, plan.scenarios[0]
    content = {
        "format": FILE_FORMAT,
        "version": FILE_VERSION,
        "made_with": versions(),
        "filter": {
            "name": choice.name,
            "numbers": choice.numbers,
            "model": {**choice.model, "parameter_factors": dict(scenario.parameter_factors)},
        },
        "scenario": scenario.name,
        "plant": plant_data(scenario.plant),
        "scenarios": {one.name: _kept(one) for one in plan.scenarios if one.name not in SCENARIOS},
        "study": {
            "name": study_name,
            **plan.identity,
            "method": method,
            "trials": result.finished,
            "best_training_value": result.best_value if method == "optuna" else None,
            "microseconds_a_step": result.microseconds,
            **consistency(result),
        },
        "held_out": {one.name: metrics(proof) for one, proof in zip(plan.scenarios, proofs, strict=True)},
    }
    write_whole(Path(path), json.dumps(sealed(content), indent=2) + "\n")


def _kept(scenario: Problem) -> dict:
    """A scenario as a tuned file keeps it, to do without the file that it comes from."""
    return {"digest": scenario.digest, "content": scenario.as_mapping()}


def scenario_in(content: Mapping, name, path: str | Path) -> Problem:
    """A scenario that a tuned file names: of the package, or as the file keeps it.

    A file without it (version 2) has only the path of a scenario's own file, which is then read.

    Args:
        content: of the tuned file, from `read_tuned_file`.
        name: of the scenario.
        path: of the tuned file, for errors.

    Raises:
        ValueError: if there is no such scenario, or what is kept is none.
    """
    kept = content.get("scenarios", {}).get(name) if isinstance(name, str) and name not in SCENARIOS else None
    if kept is None:
        return find_problem(name)
    return scenario_of(kept.get("content") if isinstance(kept, Mapping) else kept, name, path)


def _warn_of_changes(content: Mapping, path: str | Path) -> None:
    """Warn of each scenario file that says something else now than what the tuned file keeps."""
    for name in content.get("scenarios", {}):
        if not name.endswith(".toml") or not Path(name).is_file():
            continue
        then = scenario_in(content, name, path).digest
        try:
            now = find_problem(name).digest
        except ValueError:
            now = "none that can be read"
        if now != then:
            warnings.warn(
                f"{name} is not the scenario that {path} was tuned on (digest {then} then, {now} now): "
                "what was tuned on is what counts here",
                stacklevel=3,
            )


def check_plant(path: str | Path, scenario: Problem) -> None:
    """Raise ValueError if a tuned file is for another plant than a scenario's: another thruster, dt or sensor."""
    tuned_for = read_tuned_file(path).get("plant")
    if tuned_for is not None:
        check_same_plant(tuned_for, scenario.plant, path)


def read_tuned(path: str | Path) -> tuple[Choice, Problem, int]:
    """Choice, scenario and study seed of a tuned file; ValueError that says what is wrong with a bad one.

    A scenario of a file of its own is that of the time of tuning; a warning says if the file has changed since.
    """
    content = read_tuned_file(path)
    entry = content["filter"]
    try:
        seed = at_least("seed", content["study"]["seed"], 0)
        scenario = scenario_in(content, content["scenario"], path)
        _warn_of_changes(content, path)
        given = dict(entry["model"])
        factors = given.pop("parameter_factors", {})
        model = {
            "process_noise_cov": _noise(given.pop("process_noise_cov")),
            "measurement_noise_cov": positive("measurement_noise_cov", given.pop("measurement_noise_cov")),
        }
        if "prior_cov_factor" in given:
            model["prior_cov_factor"] = positive("prior_cov_factor", given.pop("prior_cov_factor"))
    except (KeyError, TypeError) as error:
        raise ValueError(f"a tuned file must have all its entries, but {path} lacks or bends {error}") from None
    if given or factors != dict(scenario.parameter_factors):
        raise ValueError(
            f"the model of a tuned file must be that of its scenario, {dict(scenario.parameter_factors)}, "
            f"but {path} has {shown(entry['model'])}"
        )
    choice = Choice(entry["name"], model, dict(entry["numbers"]))
    choice.filter(scenario)  # a clear error for numbers that the filter does not take
    return choice, scenario, seed


def _noise(given) -> tuple:
    """Q as a choice holds it: variances, or the rows of a matrix."""
    matrix = covariance("process_noise_cov", given, 2, positive_definite=True)
    return frozen((matrix if np.ndim(given) == 2 else np.diag(matrix)).tolist())


def metrics(proof: Comparison) -> dict:
    """The figures of a proof on held-out seeds as plain numbers for JSON."""
    return {
        "seeds": [proof.seeds.start, proof.seeds.stop],
        "bound": [None if math.isnan(part) else part for part in proof.bound.tolist()],
        **{name: _summary_of(getattr(proof, name)) for name in ("untuned", "tuned", "true", "scaled")},
        "scaled_default": scaling(proof),
    }


def _summary_of(evaluation: Evaluation | None) -> dict | None:
    return None if evaluation is None else summary(evaluation)


def scaling(proof: Comparison) -> dict:
    """The factor on Q that makes the scaled default, and its mean NIS on the training runs, or None."""
    found = proof.default
    return {"factor": found and found.factor, "mean_nis": found and found.nis}


def consistency(result: StudyResult) -> dict:
    """Whether any trial of a study was consistent, and the mean NIS of its choice, as plain numbers for JSON."""
    nis = [ratio if math.isfinite(ratio) else None for ratio in result.nis]
    return {"any_trial_consistent": result.consistent, "mean_nis": nis, "nis_band": list(NIS_BAND)}


def versions() -> dict[str, str]:
    """Versions of the packages that a tuned file depends on, as they are installed."""
    return {name: _version(name) for name in PACKAGES}


def summary(evaluation: Evaluation) -> dict:
    """The figures of an evaluation as plain numbers for JSON, None where there is nothing to tell."""
    return {
        "rmse": [_numbers(value) for value in evaluation.rmse],
        "start_up_rmse": [None if math.isnan(part) else part for part in evaluation.start_up_rmse.tolist()],
        **{_key(evaluation.outputs[symbol]): _numbers(one) for symbol, one in evaluation.output_rmse.items()},
        "score": _numbers(evaluation.score),
        "nees": _numbers(evaluation.nees),
        "nis": _numbers(evaluation.nis),
        "log_likelihood": None if math.isnan(evaluation.log_likelihood) else evaluation.log_likelihood,
        "divergences": evaluation.divergences,
    }


def _key(output: Quantity) -> str:
    """What the RMSE of a derived output is called in a file: "thrust_rmse" of the thrust."""
    return f"{output.name.replace(' ', '_')}_rmse"


def _numbers(value: Interval) -> list[float] | None:
    return None if math.isnan(value.value) else list(value)


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
