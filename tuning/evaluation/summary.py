"""Evaluations as plain numbers, as stored in files and studies, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from filters.consistency.intervals import Interval
from filters.consistency.time_constants import TimeConstants
from filters.starts import Restarts
from thruster_env.model.quantities import Quantity
from tuning.evaluation.evaluate import NOTHING, Evaluation
from tuning.problems.problem import Problem


def summary(evaluation: Evaluation) -> dict:
    """The results of an evaluation as plain numbers for JSON, None if there is no value."""
    return {
        "rmse": [numbers(value) for value in evaluation.rmse],
        "start_up_rmse": _plain(evaluation.start_up_rmse),
        **{_key(evaluation.outputs[symbol]): numbers(one) for symbol, one in evaluation.output_rmse.items()},
        "score": numbers(evaluation.score),
        "nees": numbers(evaluation.nees),
        "state_nees": _plain(evaluation.state_nees),
        "nis": numbers(evaluation.nis),
        "log_score": numbers(evaluation.log_score),
        "log_likelihood": None if math.isnan(evaluation.log_likelihood) else evaluation.log_likelihood,
        "divergences": evaluation.divergences,
        **({"time_constants": _time_constants(evaluation.time_constants)} if evaluation.time_constants else {}),
        **({"restarts": evaluation.restarts._asdict()} if evaluation.restarts else {}),
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
    outputs = {
        symbol: output.quantity for symbol, output in model.outputs.items() if _key(output.quantity) in data
    }
    likelihood = _number(data["log_likelihood"])
    return Evaluation(
        states=model.states[: len(rmse)],
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


def _time_constants(found: TimeConstants) -> dict:
    """Time constants as plain numbers, None in place of an infinite one."""
    steps = [part if math.isfinite(part) else None for part in (*found.steps, found.uptake)]
    known = {name: value for name, value in found._asdict().items() if value is not None}
    lists = {"steps": steps[:-1], "unobservable": list(found.unobservable)}
    if found.oracle is not None:
        lists["oracle"] = [part if math.isfinite(part) else None for part in found.oracle]
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
