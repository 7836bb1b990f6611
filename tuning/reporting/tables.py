"""Tables of parameters, of what a search tried, and of what data determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thruster_env.core.text_tables import Table
from tuning.likelihood.gradient import GradientResult
from tuning.problems.problem import Problem
from tuning.reporting.choice_words import number_rows
from tuning.search.among_types import TypeResult
from tuning.search.parameters import index_pairs
from tuning.search.plan import LIKELIHOOD, PROPER, Plan, reported, reported_name
from tuning.search.space import Choice


def choice_table(choices: Mapping[str, Choice], scenario: Problem) -> Table:
    """The parameters of filters of one type, a column each."""
    kind, caption = next(iter(choices.values())).name, ""
    model = scenario.model()
    rows = number_rows(list(choices.values()), kind, scenario, _number)
    if kind == "kf" and model.operating_input is not None:
        pairs = zip(model.operating_input, model.input_quantities, strict=True)
        about = ", ".join(f"{value:g} {quantity.unit}".rstrip() for value, quantity in pairs)
        caption = f"kf: on the affine approximation about {about}"
    return Table(f"Parameters of the {kind} filter", ["", *choices], rows, caption=caption)


def _number(value) -> str:
    return "default" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def front_table(plan: Plan, front: Sequence) -> Table:
    """The Pareto front of trials, the best in the first objective first."""
    names = list(dict.fromkeys(name for trial in front for name in trial.params))
    rows = [
        [str(trial.number + 1)]
        + [f"{reported(*pair):.4g}" for pair in zip(plan.objectives, trial.values, strict=True)]
        + [_number(trial.params.get(name, "")) for name in names]
        for trial in sorted(front, key=lambda trial: trial.values)
    ]
    caption = "No other trial is better in both objectives. The first one is the tuned filter."
    return Table(
        f"Pareto front on the training {plan.scenarios[0].seed_word}",
        ["trial", *map(reported_name, plan.objectives), *names],
        rows,
        caption=caption,
    )


def kinds_table(kinds: Sequence[TypeResult], plan: Plan) -> Table:
    """Filter types that a study tried, the best first."""
    objective = plan.objectives[0]
    rows = [
        [kind.name, str(kind.trials), str(kind.pruned), str(kind.over_budget), kind.best(objective)]
        + ["" if kind.microseconds is None else f"{kind.microseconds:.3g}"]
        for kind in kinds
    ]
    columns = ["filter", "trials", "pruned", "over\nbudget", f"best\n{reported_name(objective)}", "us/step"]
    caption = (
        "us/step: time of the best trial, or of the fastest if none is complete. *: mean NIS outside its band."
    )
    best = [0] if len(rows) > 1 else []
    title = f"Filters that were tried, on the training {plan.scenarios[0].seed_word}"
    return Table(title, columns, rows, caption=caption, best=best)


MOST_FACTORS = 4  # of a start, that fit into a caption


def gradient_table(result: GradientResult, seed_word: str = "seeds") -> Table:
    """Where each start led, and how well the data determine the optimum."""
    likeliest = result.objective == LIKELIHOOD
    starts = "; ".join(", ".join(f"{factor:g}" for factor in factors) for factors in result.starts)
    caption = f"starts: factors {starts} on the untuned values" if len(result.free) <= MOST_FACTORS else ""
    rows = []
    for i, (parameter, error) in enumerate(zip(result.free, result.standard_errors.tolist(), strict=True)):
        of_factor = f"± {100 * error:.0f} %" if error < 1 else f"x/: {np.exp(error):.2g}"
        values = [f"{optimum.parameters[i]:.4g}" for optimum in result.optima]
        name = index_pairs(parameter.name) + (f" [{parameter.unit}]" if parameter.unit else "")
        rows.append([name, *values, of_factor if parameter.log else f"± {error:.2g}"])
    levels = [
        optimum.level if likeliest else reported(result.objective, optimum.level) for optimum in result.optima
    ]
    rows.append(
        [reported_name(result.objective), *(f"{level:{'.2f' if likeliest else '.6g'}}" for level in levels), ""]
    )
    rows.append(["evaluations", *(str(optimum.evaluations) for optimum in result.optima), ""])
    what = f"{'Maximum' if result.objective in PROPER else 'Minimum'} of {reported_name(result.objective)}"
    what = "Maximum of the innovations' likelihood" if likeliest else what
    titles = [f"start {i + 1}" for i in range(len(result.starts))]
    return Table(f"{what} on the training {seed_word}", ["", *titles, "standard error"], rows, caption=caption)
