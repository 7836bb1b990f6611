"""Sections of a report: the advice, the results, the course of the search, and ensemble sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isnan
from textwrap import fill

from numpy import isfinite
from optuna import Study
from optuna.trial import FrozenTrial

from filters.consistency.verdicts import rounded
from tuning.evaluation.evaluate import restart_sentences
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.sizes import SizeRow
from tuning.evaluation.worth import all_warnings, memory_sentence, scaling_sentence, without_truth, worth
from tuning.problems.problem import score_label
from tuning.reporting.alternatives import of_comparison, of_front, of_history, of_importances, of_sizes, of_slices
from tuning.reporting.choice_words import choice_sentences
from tuning.reporting.figures import draw_comparison, draw_history
from tuning.reporting.page import Part, Picture, Section, Table, Words
from tuning.reporting.residual_words import consistency_of, model_doubts
from tuning.reporting.search_figures import (
    FEWEST_TRIALS,
    counted_trials,
    draw_front,
    draw_importance,
    draw_sizes,
    draw_slices,
    importances,
)
from tuning.reporting.sketchbook import Sketchbook
from tuning.reporting.subject import Subject
from tuning.reporting.tables import errors_table
from tuning.search.filter_types import filter_types_tried, trials_of_type
from tuning.search.objectives import reported_about, reported_name
from tuning.search.plan import SIZE_SEEDS, Plan
from tuning.search.ranges import range_warning
from tuning.search.space import AUTO, Choice

MANY_TRIALS = 50


def advice(choice: Choice, plan: Plan, comparisons: Sequence[Comparison], chosen: Mapping | None = None) -> str:
    """The choice and its reason, if `chosen` has them; the gain of tuning, N, and whether the covariance is right.

    The covariance is checked by the mean NEES; without truth by the mean NIS.
    """
    places = [f" on {scenario.name}" if len(comparisons) > 1 else "" for scenario in plan.scenarios]
    gains = [f"{worth(comparison)}{place}" for comparison, place in zip(comparisons, places, strict=True)]
    subject = "On held-out runs the tuned filter" if chosen else "Tuning"
    parts = [f"{subject} {' and '.join(gains)}"]
    if "ensemble_size" in choice.numbers:
        parts.append(f"take N = {choice.numbers['ensemble_size']}")
    squares = [consistency_of(comparison) for comparison in comparisons]
    if not any(isnan(mean.value) for _, mean, *_ in squares):
        found = [
            f"{word}{place} (mean {name} {rounded(mean.value)}, expected {right:.3g})"
            for (name, mean, right, word), place in zip(squares, places, strict=True)
        ]
        parts.append(f"the covariance is {' and '.join(found)}")
    warned = all_warnings(comparisons, plan.scenarios, plan.forget)
    warned += range_warning(choice, plan)
    doubts = [model_doubts(*pair, plan.seed) for pair in zip(plan.scenarios, comparisons, strict=True)]
    return " ".join([*choice_sentences(chosen, plan), "; ".join(parts) + ".", *warned, *sum(doubts, [])])


def held_out_section(book: Sketchbook, subject: Subject, comparisons: Sequence[Comparison]) -> Section:
    """Errors before and after, scenario by scenario; without truth metrics of the innovations."""
    parts: list[Part] = []
    for scenario, comparison in zip(subject.plan.scenarios, comparisons, strict=True):
        restarts = [*restart_sentences(comparison.evaluations), memory_sentence(comparison.tuned, scenario)]
        if not comparison.tuned.has_truth:
            parts += [Words([without_truth(scenario.name)]), errors_table(scenario, comparison)]
            parts.append(Words(restarts))
            continue
        where = f"{len(comparison.seeds)} held-out {scenario.seed_word} of {scenario.name}"
        bound = ", and the bound" if isfinite(comparison.bound).any() else ""
        name, place = subject.choice.name, f"{subject.choice.name} on {scenario.name}"
        scaling = scaling_sentence(comparison)
        said = [*([scaling] if scaling else []), *restarts]
        parts += [errors_table(scenario, comparison), Words(said)]
        caption = f"RMSE on {where} with 95 % intervals{bound}. Each panel has its own axis."
        parts.append(book.picture(draw_comparison(comparison, place, name), caption, of_comparison(comparison)))
    return Section(f"Before and after, on held-out {subject.plan.scenarios[0].seed_word}", parts)


def search_section(book: Sketchbook, subject: Subject) -> Section:
    """The course of the study: convergence, importances, slices, and the front of two objectives."""
    study, title = subject.study, "The study"
    if study is None:
        said = f"Study {subject.name!r} is not in the storage, so its course is not shown here."
        return Section(title, [Words([said])])
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
        parts.append(_kinds_table(trials, objectives[0]))
    if len(objectives) > 1:
        caption = "Trials by both objectives; no trial is better than those of the Pareto front in both."
        picture = draw_front(trials, study.best_trials, labels, objectives)
        parts.append(book.picture(picture, caption, of_front(study.best_trials, objectives)))
    return Section(title, parts)


def _importance_part(book: Sketchbook, study: Study, word: str) -> Picture | Words:
    """Importances, and how they were computed; or how many trials they need."""
    found = importances(study)
    if not found:
        return Words([f"Importances need {FEWEST_TRIALS} finished trials or more."])
    complete, early = counted_trials(study)
    rough = ", rough on so few" if complete + early < MANY_TRIALS else ""
    pruned = f" and {early} pruned ones, each at the mean of the {word} that it reached" if early else ""
    caption = (
        "Importance of each parameter for a trial to be among the best tenth, from the difference between "
        f"its values there and those of all trials (PED-ANOVA): {complete} complete trials{pruned}{rough}."
    )
    return book.picture(draw_importance(found), caption, of_importances(found))


def _kinds_table(trials: Sequence[FrozenTrial], objective: str) -> Table:
    """Filter types that the trials chose, the best first."""
    columns = ["filter", "trials", "pruned", "over budget", f"best {reported_name(objective)}", "µs/step"]
    rows = [
        [kind.name, f"{kind.trials}", f"{kind.pruned}", f"{kind.over_budget}"]
        + [kind.best(objective)]
        + ["" if kind.microseconds is None else f"{kind.microseconds:.4g}"]
        for kind in filter_types_tried(trials)
    ]
    caption = "Filters that were tried; the slices are those of the best"
    return Table(f"{caption}. *: mean NIS outside its band, chosen only if all are", columns, rows)


def sizes_section(book: Sketchbook, subject: Subject, sizes: Sequence[SizeRow]) -> Section:
    """Errors against ensemble size, with the number of seeds of each if they differ."""
    first = subject.plan.scenarios[0]
    fresh = first.size_seeds(subject.plan.seed, SIZE_SEEDS)
    where = f"{first.seed_word} {fresh.start} to {fresh.stop - 1} of {first.name}"
    caption = f"RMSE with 95 % intervals on {where}, which chose neither Q nor R; dashed is N."
    kept = subject.choice.numbers["ensemble_size"]
    ratios = [[f"{row.size}", f"{row.ratio.value:.4f}", f"{row.ratio.high:.4f}", f"{row.seeds}"] for row in sizes]
    said = (
        f"Score relative to the best, paired on the same {first.seed_word}; the largest of several scenarios. "
        "The smallest N whose upper end is below 1.01 is sufficient"
    )
    columns = ["N", "score over the best", "upper end of its 95 % interval", first.seed_word]
    if len({row.seeds for row in sizes}) == 1:
        columns, ratios = columns[:-1], [row[:-1] for row in ratios]
    picture = book.picture(draw_sizes(sizes, kept), caption, of_sizes(sizes, kept))
    return Section("Error against ensemble size", [picture, Table(said, columns, ratios)])
