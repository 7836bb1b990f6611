"""Sections of a report on the setup: the score, the model, assumed Q and R, and the facts of the study."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, sqrt

from optuna.trial import TrialState

from filters.registry import filter_type
from thruster_env.model.quantities import Quantity
from tuning.evaluation.versions import versions
from tuning.problems.problem import BOUND, OPEN_LOOP, Problem
from tuning.reporting.page import Section, Table, Words
from tuning.reporting.subject import Subject
from tuning.search.objectives import NIS_BAND, find_objective
from tuning.search.parameters import index_pairs
from tuning.search.plan import TRAINING_SEEDS, Plan
from tuning.search.ranges import range_words
from tuning.search.space import Choice

MOST_ROWS = 40  # of a table of variances


def score_section(subject: Subject) -> Section:
    """The definition of the score, in words and with its scales."""
    said = []
    for scenario in subject.plan.scenarios:
        if scenario.scale is None:
            said.append(
                f"{scenario.name} has no truth, so there is no score. The criterion is the log-likelihood of "
                "the innovations, the probability that the filter assigns to the measurements; higher is "
                "better."
            )
            continue
        states = scenario.quantities.states
        scales = [
            f"{scale:.4g} {state.unit}".rstrip() + f" for {state.text_symbol}"
            for state, scale in zip(states, scenario.scale, strict=False)
            if isfinite(scale)
        ]
        said.append(
            f"The score of a filter on {scenario.name} is the mean over {', '.join(_scored(scenario))} of its "
            f"RMSE over a fixed scale: {', '.join(scales)}. It has no unit, lower is better, and 1 means "
            f"errors as large as the scale, which is {scenario.scale_about}.{_no_bound(scenario)}"
        )
    said.append(
        f"The filter tuned on training {_word(subject)} is evaluated on held-out {_word(subject)}, which no "
        "trial saw. Intervals contain 95 % of resampled sets of runs; ratios are paired, run by run."
    )
    return Section("What the score is", [Words(said)])


def _no_bound(scenario: Problem) -> str:
    """Why a score uses another scale than the bound; empty if it uses the bound."""
    if scenario.scale_about == BOUND:
        return " It is the least error that any filter can have."
    if not scenario.scale_about.startswith(OPEN_LOOP):
        return ""
    return (
        " A posterior Cramér-Rao bound needs the inverse of Q: one state without process noise rules it out, "
        "so scores here cannot be compared with those of a problem whose scale is the bound."
    )


def _scored(scenario: Problem) -> list[str]:
    pairs = zip(scenario.quantities.states, scenario.scale or (), strict=False)
    return [state.text_symbol for state, scale in pairs if isfinite(scale)]


def _word(subject: Subject) -> str:
    return subject.plan.scenarios[0].seed_word


def model_section(choice: Choice, scenario: Problem) -> Section:
    """The model that the tuned filter assumes, and its Q and R in words and numbers."""
    model, kind = scenario.model(**choice.model), filter_type(choice.name).filter_class
    f = "f" if model.substeps == 1 else f"f (of {model.substeps} equal parts a step)"
    sample = f", one step each {scenario.dt:g} s" if scenario.dt else ""
    said = [
        f"x[k+1] = f(x[k], u[k]) + w, z[k] = h(x[k]) + v: {f} moves {_listed(model.states)} under "
        f"{_listed(model.input_quantities) or 'no input'}; h gives {_listed(model.measurements)}{sample}.",
    ]
    if not kind.has_covariance:
        said.append(f"The filter {choice.name} has neither Q nor R.")
        return Section("Model, Q and R", [Words(said)])
    said.append(
        "The filter assumes that w and v are white Gaussian noise of covariance Q and R. Covariances are per "
        "step and do not scale with dt: another sample time needs another Q."
    )
    said += [
        f"In each step {one.text_symbol} moves by {_amount(variance, one)} (standard deviation) beyond the model."
        for one, variance in zip(model.states, model.process_noise_cov.diagonal(), strict=True)
    ][:6]
    said += [
        f"A reading of {one.text_symbol} is off by {_amount(variance, one)} (standard deviation)."
        for one, variance in zip(model.measurements, model.measurement_noise_cov.diagonal(), strict=True)
    ][:6]
    if "ensemble_size" in choice.numbers:
        said.append(f"It carries {choice.numbers['ensemble_size']} members.")
    rows = [*_rows("Q", model.process_noise_cov, model.states), *_rows("P0 ", model.prior_cov, model.states)]
    rows += _rows("R", model.measurement_noise_cov, model.measurements)
    columns = ["", "of", "variance", "standard deviation"]
    table = Table("Diagonals of Q, of P_0, the prior's covariance, and of R", columns, rows[:MOST_ROWS])
    return Section("Model, Q and R", [Words(said), table])


def _rows(name: str, matrix, quantities: Sequence[Quantity]) -> list[list[str]]:
    found = []
    for i, one in enumerate(quantities):
        unit = f" {one.unit}" if one.unit else ""
        square = "" if not one.unit else f" ({one.unit})²" if set("/ ^") & set(one.unit) else f" {one.unit}²"
        deviation = sqrt(max(matrix[i, i], 0.0))
        found.append(
            [
                index_pairs(f"{name}{i + 1}{i + 1}"),
                one.text_symbol,
                f"{matrix[i, i]:.4g}{square}",
                f"{deviation:.4g}{unit}",
            ]
        )
    return found


def _amount(variance: float, one: Quantity) -> str:
    return f"{sqrt(max(variance, 0.0)):.3g} {one.unit}".rstrip()


def _listed(quantities: Sequence[Quantity]) -> str:
    names = [one.name if one.symbol in one.name.split() else f"{one.name} {one.text_symbol}" for one in quantities]
    return ", ".join(
        f"{name}{f' [{one.unit}]' if one.unit else ''}" for name, one in zip(names, quantities, strict=True)
    )


def facts_section(subject: Subject, nis: Sequence[float]) -> Section:
    """What was tuned, on which data and how; `nis` is the choice's on training seeds, over the channels."""
    plan, word = subject.plan, _word(subject)
    trained = dict.fromkeys(one.training_seeds(plan.seed, TRAINING_SEEDS) for one in plan.scenarios)
    about = [f"{one.name}: {one.about}" if one.about else one.name for one in plan.scenarios]
    rows = [
        ["filter", plan.filter if plan.filter == subject.choice.name else f"{plan.filter}: {subject.choice.name}"],
        *([["budget", f"{plan.budget:g} µs a step of one core"]] if plan.budget is not None else []),
        ["scenarios" if len(about) > 1 else "scenario", "; ".join(about)],
        ["minimised", "; ".join(f"{name}: {find_objective(name).about}" for name in plan.objectives)],
        [
            "mean NIS",
            _nis_words(nis, plan) if plan.is_constrained else "free",
        ],
        ["sampler", plan.sampler],
        *([["ranges", range_words(plan)]] if range_words(plan) else []),
        [f"training {word}", "; ".join(f"{some[0]} to {some[-1]}" for some in trained)],
        ["study", subject.name],
    ]
    if subject.study is not None:
        states = [trial.state for trial in subject.study.get_trials(deepcopy=False)]
        complete, early = states.count(TrialState.COMPLETE), states.count(TrialState.PRUNED)
        rows.append(["finished trials", f"{complete + early}, {early} of them pruned"])
    rows.append(["computed here with", ", ".join(f"{name} {version}" for name, version in versions().items())])
    return Section("What was done", [Table("", [], rows)])


def _nis_words(nis: Sequence[float], plan: Plan) -> str:
    word, channels = plan.scenarios[0].seed_word, len(plan.scenarios[0].quantities.measurements)
    low, high = NIS_BAND
    place = "inside" if all(low <= ratio <= high for ratio in nis) else "outside"
    found, low, high = " and ".join(f"{channels * ratio:.3g}" for ratio in nis), channels * low, channels * high
    return (
        f"to lie between {low:g} and {high:g}, where {channels} is right; it is {found}, {place}, on the "
        f"training {word}"
    )
