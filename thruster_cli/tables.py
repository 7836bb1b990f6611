"""Tables of choices and of what they achieve, shared by several commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isnan

import numpy as np
from rich.table import Table

from filters.registry import filter_class
from thruster_cli.output import table
from tuning.evaluate import Evaluation, Interval
from tuning.gradient import GradientResult
from tuning.plan import Plan
from tuning.scenarios import Scenario
from tuning.space import Choice

Q_UNITS = ("(rad/s)^2", "(m/s)^2")


def choice_table(choices: Mapping[str, Choice], scenario: Scenario) -> Table:
    """The numbers of filters of one kind, a column each."""
    kind, caption = next(iter(choices.values())).name, None
    models, rows = [choice.model for choice in choices.values()], []
    if filter_class(kind).has_covariance:
        rows = [
            [f"Q{i}{i} [{unit}]", *(f"{model['process_noise_cov'][i - 1]:.4g}" for model in models)]
            for i, unit in enumerate(Q_UNITS, start=1)
        ]
        unit = "N^2" if scenario.plant.channels == ("thrust",) else "(rad/s)^2"
        rows.append([f"R [{unit}]", *(f"{model['measurement_noise_cov']:.4g}" for model in models)])
    for name in dict.fromkeys(name for choice in choices.values() for name in choice.numbers):
        label = "N" if name == "ensemble_size" else name.replace("_", " ")
        rows.append([label, *(_number(choice.numbers.get(name)) for choice in choices.values())])
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
        speed, flow = evaluation.rmse
        states = [about(speed, 3), f"{round(above[0]):+d}", about(flow, 4), f"{round(above[1]):+d}"]
        honesty = (_unless_blank(mean.value, ".3g") for mean in (evaluation.nees, evaluation.nis))
        rows.append([name, *states, about(evaluation.thrust_rmse, 3), *honesty])
    rows.append(["bound", f"{bound[0]:.3f}", "", f"{bound[1]:.4f}", "", "", "2", "1"])
    columns = ["filter", "omega_m\n[rad/s]", "above\n[%]", "U_a\n[m/s]", "above\n[%]", "T\n[N]", "NEES", "NIS"]
    caption = "above: the bound. ±: half of the 95 % interval. Honest: NEES 2, NIS 1."
    return table(title, columns, rows, caption=caption)


def front_table(plan: Plan, front: Sequence) -> Table:
    """Trials that no other beats in both objectives, the best in the first objective first."""
    names = list(front[0].params)
    rows = [
        [str(trial.number + 1), *(f"{v:.4g}" for v in trial.values), *(_number(trial.params[n]) for n in names)]
        for trial in sorted(front, key=lambda trial: trial.values)
    ]
    caption = "No trial is better in both. The first one is the tuned filter."
    return table("Pareto front on the training seeds", ["trial", *plan.objectives, *names], rows, caption=caption)


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
    columns = ["start, factors on the untuned", *found.names, "log L", "evaluations"]
    return table("Maximum of the innovations' likelihood on the training seeds", columns, rows)


def about(value: Interval, digits: int) -> str:
    """A value with half of its 95 % interval; empty if there is no value."""
    half_width = (value.high - value.low) / 2
    return "" if isnan(value.value) else f"{value.value:.{digits}f} ±{half_width:.{digits}f}"


def span(value: Interval, digits: int) -> str:
    """A value with its 95 % interval in brackets."""
    return f"{value.value:.{digits}f} [{value.low:.{digits}f}, {value.high:.{digits}f}]"


def _unless_blank(value: float, form: str) -> str:
    return "" if isnan(value) else format(value, form)
