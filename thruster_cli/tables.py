"""Tables of choices and of what they achieve, shared by several commands."""

from __future__ import annotations

from collections.abc import Mapping
from math import isnan

import numpy as np
from rich.table import Table

from thruster_cli.output import table
from tuning.evaluate import Evaluation, Interval
from tuning.scenarios import Scenario
from tuning.space import Choice

Q_UNITS = ("(rad/s)^2", "(m/s)^2")


def choice_table(choices: Mapping[str, Choice], scenario: Scenario) -> Table:
    """The numbers of filters of one kind, a column each."""
    models = [choice.model for choice in choices.values()]
    rows = [
        [f"Q{i}{i} [{unit}]", *(f"{model['process_noise_cov'][i - 1]:.4g}" for model in models)]
        for i, unit in enumerate(Q_UNITS, start=1)
    ]
    rows.append(["R [N^2]", *(f"{model['measurement_noise_cov']:.4g}" for model in models)])
    sizes = [choice.numbers.get("ensemble_size") for choice in choices.values()]
    if None not in sizes:
        rows.append(["N", *map(str, sizes)])
    kind, caption = next(iter(choices.values())).name, None
    if kind == "kf":
        caption = f"kf: on the affine approximation about {scenario.model().operating_input[0]:g} V"
    return table(f"Numbers of the {kind} filter", ["", *choices], rows, caption=caption)


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


def about(value: Interval, digits: int) -> str:
    """A value with half of its 95 % interval; empty if there is no value."""
    half_width = (value.high - value.low) / 2
    return "" if isnan(value.value) else f"{value.value:.{digits}f} ±{half_width:.{digits}f}"


def span(value: Interval, digits: int) -> str:
    """A value with its 95 % interval in brackets."""
    return f"{value.value:.{digits}f} [{value.low:.{digits}f}, {value.high:.{digits}f}]"


def _unless_blank(value: float, form: str) -> str:
    return "" if isnan(value) else format(value, form)
