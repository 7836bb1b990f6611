"""Sections of a report: the advice, the results, the course of the search, and ensemble sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isnan, sqrt
from textwrap import fill
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import optuna
from numpy import isfinite
from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from filters.consistency.report import rounded, sentences
from filters.registry import filter_type
from thruster_env.core.files import BLUE, GREY, RUST, grid_of, new_figure, panels, tidy
from thruster_env.core.text_tables import verbatim
from thruster_env.model.quantities import Quantity
from thruster_env.model.turns import innovations_of, tangent_of
from tuning.evaluation.baselines import TUNED, baseline_size, baselines
from tuning.evaluation.evaluate import check_consistency
from tuning.evaluation.held_out import Comparison, versions
from tuning.evaluation.worth import all_warnings, tuning_effect
from tuning.problems.problem import BOUND, OPEN_LOOP, Problem, score_label
from tuning.reporting.choice_words import choice_sentences, consistency_of, model_doubts
from tuning.reporting.matlab import lines_section
from tuning.reporting.page import Part, Picture, Section, Sketchbook, Table, Words, as_parts
from tuning.reporting.search_figures import (
    CROSS,
    FEWEST_TRIALS,
    counted_trials,
    draw_comparison,
    draw_consistency,
    draw_history,
    early_trials,
    importances,
    limit_values,
    size_axis,
    words,
)
from tuning.reporting.tables import kinds_table
from tuning.reporting.time_figures import COLUMNS, sections_over_time
from tuning.search.among_types import filter_types_tried
from tuning.search.parameters import index_pairs
from tuning.search.plan import (
    NIS_BAND,
    SCORE,
    TRAINING_SEEDS,
    Plan,
    find_objective,
    range_warning,
    range_words,
    reported,
    reported_name,
)
from tuning.search.space import AUTO, FILTER_TYPE, Choice
from tuning.search.trials import best_trial, is_consistent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MANY_TRIALS = 50
MOST_ROWS = 40  # of a table of variances
NEES_NIS = (
    "NEES, the normalised estimation error squared, relates the error to the filter's covariance: if the "
    "covariance is right, its mean is the number of states. NIS, the normalised innovation squared, does the "
    "same with the innovation: its mean is the number of channels. CRPS, the continuous ranked probability "
    "score, is the error of a whole distribution, in the unit of the state."
)


class Subject(NamedTuple):
    """A choice and its source."""

    name: str  # of the study
    plan: Plan
    choice: Choice
    study: optuna.Study | None  # None where it is not in the storage
    seeds: int  # number of held-out seeds
    chosen: bool  # whether the ensemble size is that of a tuned file, or still to be chosen
    consistent: bool = False  # whether its mean NIS is in its band, where it has to be
    content: Mapping = {}  # of the tuned file
    sizes: object = None  # the table of ensemble sizes as it is kept
    validation: Mapping | None = None  # how the best trials met the baselines: `validation.as_data`
    nis: tuple[float, ...] = ()  # mean NIS over the channels on each scenario's training seeds, where it is kept


def advice(choice: Choice, plan: Plan, comparisons: Sequence[Comparison], chosen: Mapping | None = None) -> str:
    """The choice and its reason, if `chosen` has them; the gain of tuning, N, and whether the covariance is right.

    The covariance is checked by the mean NEES; without truth by the mean NIS.
    """
    suffixes = [f" on {scenario.name}" if len(comparisons) > 1 else "" for scenario in plan.scenarios]
    gains = [
        f"{tuning_effect(comparison)}{suffix}" for comparison, suffix in zip(comparisons, suffixes, strict=True)
    ]
    subject = "On held-out runs the tuned filter" if chosen else "Tuning"
    parts = [f"{subject} {' and '.join(gains)}"]
    if "ensemble_size" in choice.numbers:
        parts.append(f"take N = {choice.numbers['ensemble_size']}")
    squares = [consistency_of(comparison) for comparison in comparisons]
    if not any(isnan(mean.value) for _, mean, *_ in squares):
        consistencies = [
            f"{word}{suffix} (mean {name} {rounded(mean.value)}, expected {right:.3g})"
            for (name, mean, right, word), suffix in zip(squares, suffixes, strict=True)
        ]
        parts.append(f"the covariance is {' and '.join(consistencies)}")
    warned = all_warnings(comparisons, plan.scenarios, plan.forget)
    warned += range_warning(choice, plan)
    doubts = [model_doubts(*pair, plan.seed) for pair in zip(plan.scenarios, comparisons, strict=True)]
    return " ".join([*choice_sentences(chosen, plan), "; ".join(parts) + ".", *warned, *sum(doubts, [])])


def sections_of(
    book: Sketchbook,
    subject: Subject,
    comparisons: Sequence[Comparison],
    results: Sequence[Sequence[Table | str]],
    determined: Sequence[Section],
    sizes: Sequence[Section],
    file: str | None,
    nis: Sequence[float],
) -> list[Section]:
    """All sections of a page on a study, in their order; those on what data determine and on sizes are given."""
    choice, problems = subject.choice, subject.plan.scenarios
    remarks = [remark for problem in problems for remark in problem.remarks]
    return [
        held_out_section(book, subject, comparisons, results),
        *([Section("The data", [Words(remarks)])] if remarks else []),
        score_section(subject),
        *determined,
        model_section(choice, problems[0]),
        search_section(book, subject),
        *sizes,
        *run_sections(book, subject, comparisons[0]),
        lines_section(choice, problems[0], file),
        facts_section(subject, nis),
    ]


def held_out_section(
    book: Sketchbook,
    subject: Subject,
    comparisons: Sequence[Comparison],
    results: Sequence[Sequence[Table | str]],
) -> Section:
    """Errors before and after, scenario by scenario, with the tables and sentences of each held-out evaluation."""
    parts: list[Part] = []
    for scenario, comparison, tables in zip(subject.plan.scenarios, comparisons, results, strict=True):
        parts += as_parts(tables)
        if not comparison.tuned.has_truth:
            continue
        where = f"{len(comparison.seeds)} held-out {scenario.seed_word} of {scenario.name}"
        bound = ", and the bound" if isfinite(comparison.bound).any() else ""
        name, title = subject.choice.name, f"{subject.choice.name} on {scenario.name}"
        caption = f"RMSE on {where} with 95 % intervals{bound}. Each panel has its own axis."
        parts.append(book.picture(draw_comparison(comparison, title, name), caption, of_comparison(comparison)))
    return Section(f"Before and after, on held-out {subject.plan.scenarios[0].seed_word}", parts)


def of_front(front: Sequence[FrozenTrial], objectives: Sequence[str]) -> str:
    """Both ends of a Pareto front."""
    ends = sorted(trial.values for trial in front)
    described = [
        " and ".join(
            f"{reported_name(name)} {reported(name, value):.3g}"
            for name, value in zip(objectives, end, strict=True)
        )
        for end in ends
    ]
    return f"Pareto front of {len(front)} trials, from {described[0]} to {described[-1]}."


def trials_of_type(trials: Sequence[FrozenTrial], name: str) -> list[FrozenTrial]:
    """Trials that chose a filter type; all of them in a study of one type."""
    return [trial for trial in trials if trial.params.get(FILTER_TYPE, name) == name]


def reported_about(name: str) -> str:
    """One line on what `reported` returns, with its unit."""
    return find_objective(name).about.removeprefix("negative ").replace(", -log N", ", log N")


def search_section(book: Sketchbook, subject: Subject) -> Section:
    """The course of the study: convergence, importances, slices, and the front of two objectives."""
    study, title = subject.study, "The study"
    if study is None:
        remark = f"Study {subject.name!r} is not in the storage, so its course is not shown here."
        return Section(title, [Words([remark])])
    trials = study.get_trials(deepcopy=False)
    objectives = subject.plan.objectives
    labels = [
        score_label(subject.plan.scenarios)
        if name == "score"
        else fill(f"{reported_name(name)}: {reported_about(name)}", 34)
        for name in objectives
    ]
    word = subject.plan.scenarios[0].seed_word
    caption = f"First objective of each trial on the training {word}, and the best so far."
    picture = draw_history(trials, f"Study {subject.name}", labels[0], objectives[0])
    parts: list[Part] = [
        book.picture(picture, caption, of_history(trials, objectives[0])),
        _importance_part(book, study, word),
    ]
    caption = (
        "First objective against each parameter; dashed is the best trial. Hollow: mean NIS outside its band. "
        f"Crosses: pruned, at the mean of the {word} seen."
    )
    of_kind = trials_of_type(trials, subject.choice.name)
    parts.append(book.picture(draw_slices(of_kind, labels[0], objectives[0]), caption, of_slices(of_kind)))
    if subject.plan.filter == AUTO:
        parts.append(kinds_table(filter_types_tried(trials), subject.plan))
    if len(objectives) > 1:
        caption = "Trials by both objectives; no trial is better than those of the Pareto front in both."
        picture = draw_front(trials, study.best_trials, labels, objectives)
        parts.append(book.picture(picture, caption, of_front(study.best_trials, objectives)))
    return Section(title, parts)


def _importance_part(book: Sketchbook, study: Study, word: str) -> Picture | Words:
    """Importances, and how they were computed; or how many trials they need."""
    shares = importances(study)
    if not shares:
        return Words([f"Importances need {FEWEST_TRIALS} finished trials or more."])
    complete, early = counted_trials(study)
    rough = ", rough on so few" if complete + early < MANY_TRIALS else ""
    pruned = f" and {early} pruned ones, each at the mean of the {word} that it reached" if early else ""
    caption = (
        "Importance of each parameter for a trial to be among the best tenth, from the difference between "
        f"its values there and those of all trials (PED-ANOVA): {complete} complete trials{pruned}{rough}."
    )
    alt = f"Bars: {', '.join(f'{name} {value:.2f}' for name, value in shares.items())}."
    return book.picture(draw_importance(shares), caption, alt)


def score_section(subject: Subject) -> Section:
    """The definition of the score, in words and with its scales."""
    paragraphs, word = [], subject.plan.scenarios[0].seed_word
    for scenario in subject.plan.scenarios:
        if scenario.scale is None:
            paragraphs.append(
                f"{scenario.name} has no truth, so there is no score. The criterion is the log-likelihood of "
                "the innovations, the probability that the filter assigns to the measurements; higher is "
                "better."
            )
            continue
        states = scenario.errors
        scales = [
            f"{scale:.4g} {state.unit}".rstrip() + f" for {state.text_symbol}"
            for state, scale in zip(states, scenario.scale, strict=False)
            if isfinite(scale)
        ]
        paragraphs.append(
            f"The score of a filter on {scenario.name} is the mean over {', '.join(_scored(scenario))} of its "
            f"RMSE over a fixed scale: {', '.join(scales)}. It has no unit, lower is better, and 1 means "
            f"errors as large as the scale, which is {scenario.scale_about}.{_no_bound(scenario)}"
        )
    paragraphs.append(
        f"The filter tuned on training {word} is evaluated on held-out {word}, which no "
        "trial saw. Intervals contain 95 % of resampled sets of runs; ratios are paired, run by run."
    )
    return Section("What the score is", [Words(paragraphs)])


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
    pairs = zip(scenario.errors, scenario.scale or (), strict=False)
    return [state.text_symbol for state, scale in pairs if isfinite(scale)]


def model_section(choice: Choice, scenario: Problem) -> Section:
    """The model that the tuned filter assumes, and its Q and R in words and numbers."""
    model, kind = scenario.model(**choice.model), filter_type(choice.name).filter_class
    f = "f" if model.substeps == 1 else f"f (of {model.substeps} equal parts a step)"
    sample = f", one step each {scenario.dt:g} s" if scenario.dt else ""
    paragraphs = [
        f"x[k+1] = f(x[k], u[k]) + w, z[k] = h(x[k]) + v: {f} moves {_listed(model.states)} under "
        f"{_listed(model.input_quantities) or 'no input'}; h gives {_listed(model.measurements)}{sample}.",
    ]
    if not kind.has_covariance:
        paragraphs.append(f"The filter {choice.name} has neither Q nor R.")
        return Section("Model, Q and R", [Words(paragraphs)])
    paragraphs.append(
        "The filter assumes that w and v are white Gaussian noise of covariance Q and R. Covariances are per "
        "step and do not scale with dt: another sample time needs another Q."
    )
    errors = tangent_of(model)
    paragraphs += [
        f"In each step {state.text_symbol} moves by {_amount(variance, state)} (standard deviation) beyond the "
        "model."
        for state, variance in zip(errors, model.process_noise_cov.diagonal(), strict=True)
    ][:6]
    paragraphs += [
        f"A reading of {channel.text_symbol} is off by {_amount(variance, channel)} (standard deviation)."
        for channel, variance in zip(innovations_of(model), model.measurement_noise_cov.diagonal(), strict=True)
    ][:6]
    if "ensemble_size" in choice.numbers:
        paragraphs.append(f"It carries {choice.numbers['ensemble_size']} members.")
    rows = [*_rows("Q", model.process_noise_cov, errors), *_rows("P0 ", model.prior_cov, errors)]
    rows += _rows("R", model.measurement_noise_cov, innovations_of(model))
    columns = ["", "of", "variance", "standard deviation"]
    table = Table("Diagonals of Q, of P_0, the prior's covariance, and of R", columns, rows[:MOST_ROWS])
    return Section("Model, Q and R", [Words(paragraphs), table])


def _rows(name: str, matrix, quantities: Sequence[Quantity]) -> list[list[str]]:
    rows = []
    for i, quantity in enumerate(quantities):
        unit = f" {quantity.unit}" if quantity.unit else ""
        square = f" ({quantity.unit})²" if set("/ ^") & set(quantity.unit) else f"{unit}²" if unit else ""
        label, deviation = index_pairs(f"{name}{i + 1}{i + 1}"), sqrt(max(matrix[i, i], 0.0))
        rows.append([label, quantity.text_symbol, f"{matrix[i, i]:.4g}{square}", f"{deviation:.4g}{unit}"])
    return rows


def _amount(variance: float, quantity: Quantity) -> str:
    return f"{sqrt(max(variance, 0.0)):.3g} {quantity.unit}".rstrip()


def _listed(quantities: Sequence[Quantity]) -> str:
    names = [
        quantity.name if quantity.symbol in quantity.name.split() else f"{quantity.name} {quantity.text_symbol}"
        for quantity in quantities
    ]
    return ", ".join(
        f"{name}{f' [{quantity.unit}]' if quantity.unit else ''}"
        for name, quantity in zip(names, quantities, strict=True)
    )


def facts_section(subject: Subject, nis: Sequence[float]) -> Section:
    """What was tuned, on which data and how; `nis` is the choice's on training seeds, over the channels."""
    plan, word = subject.plan, subject.plan.scenarios[0].seed_word
    trained = dict.fromkeys(scenario.training_seeds(plan.seed, TRAINING_SEEDS) for scenario in plan.scenarios)
    about = [
        f"{scenario.name}: {scenario.about}" if scenario.about else scenario.name for scenario in plan.scenarios
    ]
    rows = [
        ["filter", plan.filter if plan.filter == subject.choice.name else f"{plan.filter}: {subject.choice.name}"],
        *([["budget", f"{plan.budget:g} µs a step of one core"]] if plan.budget is not None else []),
        ["scenarios" if len(about) > 1 else "scenario", "; ".join(about)],
        ["minimised", "; ".join(f"{name}: {find_objective(name).about}" for name in plan.objectives)],
        ["mean NIS", _nis_words(nis, plan) if plan.is_constrained else "free"],
        ["sampler", plan.sampler],
        *([["ranges", range_words(plan)]] if range_words(plan) else []),
        [f"training {word}", "; ".join(f"{seeds[0]} to {seeds[-1]}" for seeds in trained)],
        ["study", subject.name],
    ]
    if subject.study is not None:
        states = [trial.state for trial in subject.study.get_trials(deepcopy=False)]
        complete, early = states.count(TrialState.COMPLETE), states.count(TrialState.PRUNED)
        rows.append(["finished trials", f"{complete + early}, {early} of them pruned"])
    rows.append(["computed here with", ", ".join(f"{name} {version}" for name, version in versions().items())])
    return Section("What was done", [Table("", [], rows)])


def _nis_words(nis: Sequence[float], plan: Plan) -> str:
    word, channels = plan.scenarios[0].seed_word, len(plan.scenarios[0].innovations)
    low, high = NIS_BAND
    side = "inside" if all(low <= ratio <= high for ratio in nis) else "outside"
    means, low, high = " and ".join(f"{channels * ratio:.3g}" for ratio in nis), channels * low, channels * high
    return (
        f"to lie between {low:g} and {high:g}, where {channels} is right; it is {means}, {side}, on the "
        f"training {word}"
    )


def run_sections(book: Sketchbook, subject: Subject, comparison: Comparison) -> list[Section]:
    """One held-out run over time, and whether the covariance is consistent, both on the first scenario."""
    choice, scenario = subject.choice, subject.plan.scenarios[0]
    data, tuned = scenario.data(comparison.seeds), choice.filter(scenario)
    size = baseline_size(choice)
    known = baselines(choice.name, scenario, subject.plan.seed, comparison.default, size)
    name, before = next(iter(known.items()))
    pair, dt = {name: before.filter(scenario), TUNED: tuned}, scenario.dt
    word = scenario.seed_word.removesuffix("s")
    where = f"{scenario.name}, held-out {word} {comparison.seeds.start}"
    scored = comparison.tuned.scored or None
    sections = sections_over_time(book, pair, data, dt, scored, where)
    if not filter_type(choice.name).has_covariance:
        return sections
    report = check_consistency(tuned, data, dt)
    remarks = sentences(report)
    runs = f"{report.runs} held-out {scenario.seed_word} of {scenario.name}"
    drawn = draw_consistency(report, f"{choice.name}, tuned, on {runs}", scored=scored, filter_name=choice.name)
    parts: list[Part] = [
        Words([NEES_NIS]),
        Words(remarks),
        book.picture(drawn, f"Checks of the tuned filter's covariance on {runs}.", " ".join(remarks)),
    ]
    return [*sections, Section("Is the covariance consistent?", parts)]


NO_TRIALS = "No trial was finished."


def of_history(trials: Sequence[FrozenTrial], objective: str) -> str:
    """First and best trial of a study, and how many were pruned."""
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    best = best_trial(done) if done else None
    if best is None:
        return NO_TRIALS
    early = sum(trial.state == TrialState.PRUNED for trial in trials)
    first, last = (
        f"trial {trial.number + 1} has {reported(objective, trial.values[0]):.4g}" for trial in (done[0], best)
    )
    return (
        f"{reported_name(objective)} of {len(trials)} trials, {early} of them pruned: {first}; the best, {last}."
    )


def of_comparison(comparison: Comparison) -> str:
    """RMSE of every filter, state by state, and the bound."""
    sentences = []
    for i, state in enumerate(comparison.tuned.states):
        values = [f"{name} {evaluation.rmse[i].value:.3g}" for name, evaluation in comparison.evaluations.items()]
        values += [f"bound {comparison.bound[i]:.3g}"] if isfinite(comparison.bound[i]) else []
        sentences.append(f"RMSE of {state.name}{f' in {state.unit}' if state.unit else ''}: {', '.join(values)}")
    return f"Bars with whiskers. {'; '.join(sentences)}."


def of_slices(trials: Sequence[FrozenTrial]) -> str:
    """Parameters of the best trial, and the range of the trials."""
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    best = best_trial(done) if done else None
    if best is None:
        return NO_TRIALS
    ranges = []
    for name, value in best.params.items():
        if isinstance(value, (int, float)):
            tried = [trial.params[name] for trial in done if name in trial.params]
            ranges.append(f"{name} {value:.3g}, tried from {min(tried):.3g} to {max(tried):.3g}")
    return f"Scatter of {len(done)} complete trials. The best has {'; '.join(ranges)}."


def draw_importance(importances: Mapping[str, float]) -> Figure:
    """Importance of each number, the largest above."""
    figure = new_figure((6.4, 0.9 + 0.4 * len(importances)))
    axis = figure.subplots()
    tidy([axis])
    names, values = list(importances)[::-1], list(importances.values())[::-1]
    axis.barh([words(name) for name in names], values, 0.6, color=BLUE)
    for row, value in enumerate(values):
        axis.annotate(f"{value:.2f}", (value, row), (4, 0), textcoords="offset points", va="center", fontsize=9)
    axis.margins(x=0.12)
    axis.grid(axis="y", visible=False)
    axis.set_xlabel("importance, of a sum of 1 [-]")
    return figure


def draw_slices(trials: Sequence[FrozenTrial], label: str, objective: str = SCORE) -> Figure:
    """First objective against each parameter, a panel per parameter; dashed is the best trial.

    Hollow circles have a mean NIS outside its band; crosses were pruned and stand at the mean of their seeds.
    """
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    early, names = early_trials(trials), [name for name in done[0].params if name != FILTER_TYPE]
    figure, axes = panels(len(names), COLUMNS, (3.2, 2.7), extra=0.4, sharey=True)
    best, values = best_trial(done), [trial.values[0] for trial in done]
    assert best is not None  # a report is of a study with a complete trial
    faces = [BLUE if is_consistent(trial) else "white" for trial in done]
    for axis, name in zip(axes, names, strict=True):
        tried = [trial.params[name] for trial in done]
        circles = {"s": 16, "facecolors": faces, "edgecolors": BLUE, "linewidths": 0.8, "alpha": 0.7}
        axis.scatter(tried, [reported(objective, value) for value in values], **circles)
        crosses = [trial.params[name] for trial, _ in early], [reported(objective, value) for _, value in early]
        axis.plot(*crosses, "x", **CROSS)
        axis.axvline(best.params[name], color=RUST, linestyle="--", linewidth=1)
        if getattr(best.distributions[name], "log", False):
            if len({*tried, *(trial.params[name] for trial, _ in early)}) == 1:
                axis.set_xlim(tried[0] / 2.0, tried[0] * 2.0)  # the few trials of a short study may be alike
            axis.set_xscale("log")
        if name == "N" or name.endswith(" N"):
            size_axis(axis, sorted(trial.params[name] for trial in trials if name in trial.params))
        axis.set_xlabel(verbatim(words(name)))
    limit_values(axes[0], values, objective)
    for axis in axes[:: grid_of(len(names), COLUMNS)[1]]:
        axis.set_ylabel(verbatim(label), fontsize=9)
    return figure


def draw_front(
    trials: Sequence[FrozenTrial], front: Sequence[FrozenTrial], labels: Sequence[str], objectives: Sequence[str]
) -> Figure:
    """Trials by their two objectives, and the Pareto front."""
    figure = new_figure((6.4, 4.4))
    axis = figure.subplots()
    tidy([axis])
    done = np.array([trial.values for trial in trials if trial.state == TrialState.COMPLETE])
    best = np.array(sorted(trial.values for trial in front))
    signs = np.array([reported(name, 1.0) for name in objectives])
    axis.plot(*(signs * done).T, "o", color=GREY, markersize=4, label="trial")
    steps = {"color": BLUE, "markersize": 6, "linewidth": 1, "drawstyle": "steps-post"}
    axis.plot(*(signs * best).T, "o-", label="Pareto front", **steps)
    axis.plot(*(signs * best[0]), "s", color=RUST, markersize=8, label="best in the first objective")
    for axis_name, column in (("x", 0), ("y", 1)):
        low, high = best[:, column].min(), best[:, column].max()
        room = 0.5 * (high - low) or 0.2 * abs(low) or 1.0
        near = done[done[:, column] <= high + room, column]
        pad = 0.08 * (near.max() - low) or room
        ends = signs[column] * np.array([low - pad, near.max() + pad])
        getattr(axis, f"set_{axis_name}lim")(*sorted(ends))
    axis.set_xlabel(verbatim(labels[0]))
    axis.set_ylabel(verbatim(labels[1]))
    axis.legend(frameon=False)
    return figure
