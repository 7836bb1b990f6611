"""Tables of choices and of what they achieve, shared by several commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isnan

import numpy as np
from rich.table import Table

from thruster_cli.output import table
from tuning.evaluation.evaluate import Evaluation, Interval
from tuning.likelihood.gradient import GradientResult
from tuning.search.filter_types import Kind
from tuning.search.plan import Plan
from tuning.search.space import Choice, neutral, parameters_of
from tuning.thruster.scenario import Scenario


def choice_table(choices: Mapping[str, Choice], scenario: Scenario) -> Table:
    """The numbers of filters of one kind, a column each."""
    kind, caption = next(iter(choices.values())).name, None
    unit = "N^2" if scenario.plant.channels == ("thrust",) else "(rad/s)^2"
    units = {"Q11": " [(rad/s)^2]", "Q22": " [(m/s)^2]", "R": f" [{unit}]"}
    columns = [parameters_of(choice) for choice in choices.values()]
    rows = [
        [
            name.replace("_", " ") + units.get(name, ""),
            *(_number(column.get(name, neutral(name))) for column in columns),
        ]
        for name in dict.fromkeys(name for column in columns for name in column)
    ]
    operating = scenario.model().operating_input
    if kind == "kf" and operating is not None:
        caption = f"kf: on the affine approximation about {operating[0]:g} V"
    return table(f"Numbers of the {kind} filter", ["", *choices], rows, caption=caption)


def _number(value) -> str:
    return "default" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def comparison_table(evaluations: Mapping[str, Evaluation], bound: np.ndarray, title: str) -> Table:
    """RMSE, distance from the bound and consistency of filters on the same seeds, a row each."""
    rows = []
    for name, evaluation in evaluations.items():
        above = [100.0 * (rmse.value / b - 1.0) for rmse, b in zip(evaluation.rmse, bound, strict=True)]
        above = [unless_blank(part, "+.0f") for part in above]
        speed, flow = evaluation.rmse
        states = [about(speed, 3), above[0], about(flow, 4), above[1]]
        honesty = (unless_blank(mean.value, ".3g") for mean in (evaluation.nees, evaluation.nis))
        rows.append([name, *states, about(evaluation.thrust_rmse, 3), *honesty])
    rows.append(["bound", unless_blank(bound[0], ".3f"), "", unless_blank(bound[1], ".4f"), "", "", "2", "1"])
    columns = ["filter", "omega_m\n[rad/s]", "above\n[%]", "U_a\n[m/s]", "above\n[%]", "T\n[N]", "NEES", "NIS"]
    caption = "above: the bound. ±: half of the 95 % interval. Honest: NEES 2, NIS 1."
    return table(title, columns, rows, caption=caption)


def front_table(plan: Plan, front: Sequence) -> Table:
    """Trials that no other beats in both objectives, the best in the first objective first."""
    names = list(dict.fromkeys(name for trial in front for name in trial.params))
    rows = [
        [str(trial.number + 1), *(f"{v:.4g}" for v in trial.values)]
        + [_number(trial.params.get(name, "")) for name in names]
        for trial in sorted(front, key=lambda trial: trial.values)
    ]
    caption = "No trial is better in both. The first one is the tuned filter."
    return table("Pareto front on the training seeds", ["trial", *plan.objectives, *names], rows, caption=caption)


def kinds_table(kinds: Sequence[Kind], plan: Plan) -> Table:
    """Kinds of filters that a study tried, the best first."""
    rows = [
        [kind.name, str(kind.trials), str(kind.pruned), str(kind.over_budget), _best(kind)]
        + ["" if kind.microseconds is None else f"{kind.microseconds:.3g}"]
        for kind in kinds
    ]
    columns = ["filter", "trials", "ended\nearly", "over\nbudget", f"best\n{plan.objectives[0]}", "us a\nstep"]
    caption = "us a step: of the best trial; of the cheapest where none is complete. *: mean NIS outside its band."
    return table("Filters that were tried, on the training seeds", columns, rows, caption=caption)


def _best(kind: Kind) -> str:
    return "" if kind.value is None else f"{kind.value:.4g}{'' if kind.consistent else '*'}"


def gradient_table(found: GradientResult) -> Table:
    """Where each start led, and how well the data determine the maximum."""
    rows = [
        ["x ".join(f"{factor:g}" for factor in optimum.start)]
        + [f"{variance:.4g}" for variance in optimum.variances]
        + [f"{optimum.log_likelihood:.2f}", str(optimum.evaluations)]
        for optimum in found.optima
    ]
    errors = [
        f"± {100 * error:.0f} %" if error < 1 else f"x/: {np.exp(error):.2g}" for error in found.standard_errors
    ]
    rows.append(["standard error", *errors, "", ""])
    columns = ["start, factors on the rule of thumb", *found.names, "log L", "evaluations"]
    return table("Maximum of the innovations' likelihood on the training seeds", columns, rows)


def about(value: Interval, digits: int) -> str:
    """A value with half of its 95 % interval; empty if there is no value."""
    half_width = (value.high - value.low) / 2
    return "" if isnan(value.value) else f"{value.value:.{digits}f} ±{half_width:.{digits}f}"


def span(value: Interval, digits: int) -> str:
    """A value with its 95 % interval in brackets."""
    return f"{value.value:.{digits}f} [{value.low:.{digits}f}, {value.high:.{digits}f}]"


def unless_blank(value: float, form: str) -> str:
    """A value in a form; empty if there is no value."""
    return "" if isnan(value) else format(value, form)
