"""What stands in a report: the advice, tables of what was achieved, and sections with pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isnan
from pathlib import Path
from typing import NamedTuple

from optuna.trial import FrozenTrial, TrialState

from filters.consistency.intervals import Interval
from filters.consistency.verdicts import confidence, rounded, sentences
from filters.registry import filter_class
from tuning.evaluation.baselines import RULE, TUNED, baselines
from tuning.evaluation.evaluate import check_consistency
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.sizes import SizeRow
from tuning.evaluation.tuned import versions
from tuning.evaluation.worth import scaling_sentence, worth
from tuning.likelihood.identifiability import Identifiability
from tuning.problems.problem import Problem
from tuning.problems.seeds import size_seeds, training_seeds
from tuning.report.consistency_figures import consistency_figure
from tuning.report.figures import SCORE, comparison_figure, estimates_figure, history_figure
from tuning.report.page import Picture, Section, Table, Words
from tuning.report.search_figures import (
    FEWEST_TRIALS,
    front_figure,
    importance_figure,
    importances,
    sizes_figure,
    slices_figure,
)
from tuning.report.subject import Subject
from tuning.search.filter_types import kinds_tried, trials_of_kind
from tuning.search.objectives import NIS_BAND, find_objective
from tuning.search.plan import SIZE_SEEDS, TRAINING_SEEDS, Plan
from tuning.search.space import AUTO, Choice, neutral, parameters_of

MANY_TRIALS = 50


class Sketchbook(NamedTuple):
    """A folder in which pictures are drawn that a page then holds."""

    folder: Path

    def picture(self, caption: str, draw: Callable, *arguments, **options) -> Picture:
        """What a function draws that takes a path first."""
        return Picture(draw(self.folder / "picture.png", *arguments, **options).read_bytes(), caption)


def advice(choice: Choice, plan: Plan, proofs: Sequence[Comparison]) -> str:
    """One sentence: what tuning is worth, the ensemble size to take, and whether the covariance is honest."""
    places = [f" on {scenario.name}" if len(proofs) > 1 else "" for scenario in plan.scenarios]
    gains = [f"{worth(proof)}{place}" for proof, place in zip(proofs, places, strict=True)]
    parts = [f"Tuning {' and '.join(gains)}"]
    if "ensemble_size" in choice.numbers:
        parts.append(f"take N = {choice.numbers['ensemble_size']}")
    squares, right = [proof.tuned.nees for proof in proofs], len(proofs[0].tuned.rmse)
    if not any(isnan(nees.value) for nees in squares):
        honest = [
            f"{confidence(nees, right)}{place} (mean NEES {rounded(nees.value)} where {right} is right)"
            for nees, place in zip(squares, places, strict=True)
        ]
        parts.append(f"the covariance is {' and '.join(honest)}")
    return "; ".join(parts) + "."


def errors_table(scenario: Problem, proof: Comparison) -> Table:
    """RMSE, score and consistency of a tuned filter and its baselines on held-out seeds, and the bound."""
    ratios = proof.ratios
    rows = [
        [name, *map(_span, e.rmse), _span(e.thrust_rmse), _span(e.score), _span(e.nees), _span(e.nis)]
        + [_span(ratios[name]) if name in ratios else ""]
        for name, e in proof.evaluations.items()
    ]
    right = [str(len(proof.bound)), str(proof.tuned.channels)] if rows[0][-2] else ["", ""]
    bound = ["" if isnan(part) else rounded(part) for part in proof.bound]
    rows.append(["bound; what is right", *bound, "", "", *right, ""])
    columns = ["filter", "RMSE ω_m [rad/s]", "RMSE U_a [m/s]", "RMSE thrust [N]", "score", "mean NEES", "mean NIS"]
    columns.append("score of tuned over this")
    seeds = f"held-out seeds {proof.seeds.start} to {proof.seeds.stop - 1}"
    return Table(f"{scenario.name}, {seeds}, with 95 % intervals", columns, rows)


def numbers_table(choice: Choice, scenario: Problem, seed: int) -> Table:
    """The numbers of a tuned filter and of its baselines."""
    found = baselines(choice.name, scenario, seed)
    choices, default = {TUNED: choice, **found}, found[RULE].numbers
    columns = [parameters_of(one._replace(numbers={**default, **one.numbers})) for one in choices.values()]
    unit = "N²" if scenario.plant.channels == ("thrust",) else "(rad/s)²"
    units = {"Q11": " [(rad/s)²]", "Q22": " [(m/s)²]", "R": f" [{unit}]"}
    rows = [
        [name.replace("_", " ") + units.get(name, "")]
        + [f"{column.get(name, neutral(name)):.4g}" for column in columns]
        for name in dict.fromkeys(name for column in columns for name in column)
    ]
    return Table(f"Numbers of the {choice.name} filter", ["", *choices], rows)


def known_table(found: Identifiability) -> Table:
    """What the innovations alone say of the numbers, and whether they determine them."""
    columns = found.names, found.tuned, found.likeliest, found.factors, found.identified
    rows = [
        [name, f"{tuned:.4g}", f"{best:.4g}", f"{factor:.3g}" if known else "", "yes" if known else "no"]
        for name, tuned, best, factor, known in zip(*columns, strict=True)
    ]
    header = ["", "tuned", "most likely", "known within a factor of", "determined"]
    return Table("What the innovations of the training runs say, with 95 % probability", header, rows)


def proof_section(book: Sketchbook, subject: Subject, proofs: Sequence[Comparison]) -> Section:
    """Errors before and after, scenario by scenario."""
    parts = []
    for scenario, proof in zip(subject.plan.scenarios, proofs, strict=True):
        caption = (
            f"RMSE on {len(proof.seeds)} held-out seeds of {scenario.name} with 95 % intervals, and the bound."
        )
        title = f"{subject.choice.name} on {scenario.name}"
        said = scaling_sentence(proof)
        parts += [errors_table(scenario, proof), *([Words([said])] if said else [])]
        parts.append(book.picture(caption, comparison_figure, proof, title))
    return Section("Before and after, on held-out seeds", parts)


def search_section(book: Sketchbook, subject: Subject) -> Section:
    """How the study went: convergence, importances, slices, and the front of two objectives."""
    study, title = subject.study, "The study"
    if study is None:
        said = f"Study {subject.name!r} is not in the storage, so how it went is not told here."
        return Section(title, [Words([said])])
    trials = study.get_trials(deepcopy=False)
    objectives = subject.plan.objectives
    labels = [SCORE if name == "score" else f"{name}:\n{find_objective(name).about}" for name in objectives]
    caption = "First objective of each trial on the training seeds, and the best so far."
    parts = [book.picture(caption, history_figure, trials, f"Study {subject.name}", labels[0])]
    found = importances(study)
    if found:
        complete = [trial.state for trial in trials].count(TrialState.COMPLETE)
        caption = (
            "How much each number matters for a trial to be among the best tenth: PED-ANOVA on "
            f"{complete} complete trials{', rough on so few' if complete < MANY_TRIALS else ''}."
        )
        parts.append(book.picture(caption, importance_figure, found))
    else:
        parts.append(Words([f"Importances of the numbers need {FEWEST_TRIALS} complete trials or more."]))
    caption = (
        "First objective against each number; dashed is the best trial. Hollow: mean NIS outside its band. "
        "Crosses: ended early, at the mean of the seeds seen."
    )
    parts.append(book.picture(caption, slices_figure, trials_of_kind(trials, subject.choice.name), labels[0]))
    if subject.plan.filter == AUTO:
        parts.append(_kinds_table(trials, objectives[0]))
    if len(objectives) > 1:
        caption = "Trials by both objectives; no trial beats those of the Pareto front in both."
        parts.append(book.picture(caption, front_figure, trials, study.best_trials, labels))
    return Section(title, parts)


def _kinds_table(trials: Sequence[FrozenTrial], objective: str) -> Table:
    """Kinds of filters that the trials chose, the best first."""
    columns = ["filter", "trials", "ended early", "over budget", f"best {objective}", "µs a step"]
    rows = [
        [kind.name, f"{kind.trials}", f"{kind.pruned}", f"{kind.over_budget}"]
        + ["" if kind.value is None else f"{kind.value:.4g}{'' if kind.consistent else '*'}"]
        + ["" if kind.microseconds is None else f"{kind.microseconds:.4g}"]
        for kind in kinds_tried(trials)
    ]
    caption = "Filters that were tried, on the training seeds; the slices are those of the best"
    return Table(f"{caption}. *: mean NIS outside its band, to be chosen only where all are", columns, rows)


def sizes_section(book: Sketchbook, subject: Subject, sizes: Sequence[SizeRow]) -> Section:
    """Errors against ensemble size."""
    fresh = size_seeds(subject.plan.seed, SIZE_SEEDS)
    where = f"seeds {fresh.start} to {fresh.stop - 1} of {subject.plan.scenarios[0].name}"
    caption = f"RMSE with 95 % intervals on {where}, which chose neither Q nor R; dashed is N."
    kept = subject.choice.numbers["ensemble_size"]
    ratios = [[f"{row.size}", f"{row.ratio.value:.4f}", f"{row.ratio.high:.4f}"] for row in sizes]
    said = (
        "Score over the best, paired on the same seeds; of several scenarios the largest. The smallest N whose "
        "upper end is below 1.01 is sufficient"
    )
    columns = ["N", "score over the best", "upper end of its 95 % interval"]
    picture = book.picture(caption, sizes_figure, sizes, kept)
    return Section("Error against ensemble size", [picture, Table(said, columns, ratios)])


def run_sections(book: Sketchbook, subject: Subject, proof: Comparison) -> list[Section]:
    """One held-out run over time, and whether the covariance is honest, both on the first scenario."""
    choice, scenario = subject.choice, subject.plan.scenarios[0]
    data, tuned = scenario.data(proof.seeds), choice.filter(scenario)
    name, before = next(iter(baselines(choice.name, scenario, subject.plan.seed).items()))
    pair = {name: before.filter(scenario), TUNED: tuned}
    caption = (
        f"Truth, estimate and 95 % band on {scenario.name}, held-out seed {proof.seeds.start}, before and after."
    )
    picture = book.picture(caption, estimates_figure, pair, data, 0, scenario.plant.dt, sharey="row")
    sections = [Section("One run over time", [picture])]
    if filter_class(choice.name).has_covariance:
        report = check_consistency(tuned, data)
        caption = f"Checks of the tuned filter's covariance on {report.runs} held-out seeds of {scenario.name}."
        title = f"{choice.name}, tuned, on {report.runs} seeds of {scenario.name}"
        picture = book.picture(caption, consistency_figure, report, title)
        sections.append(Section("Is the covariance honest?", [Words(sentences(report)), picture]))
    return sections


def facts_section(subject: Subject, nis: Sequence[float]) -> Section:
    """What was tuned, on what and with what; `nis` is the choice's on training seeds, over the channels."""
    plan, training = subject.plan, training_seeds(subject.plan.seed, TRAINING_SEEDS)
    about = [f"{one.name}: {one.about}" if one.about else one.name for one in plan.scenarios]
    rows = [
        ["filter", plan.filter if plan.filter == subject.choice.name else f"{plan.filter}: {subject.choice.name}"],
        *([["budget", f"{plan.budget:g} µs a step of one core"]] if plan.budget is not None else []),
        ["scenarios" if len(about) > 1 else "scenario", "; ".join(about)],
        ["made small", "; ".join(f"{name}: {find_objective(name).about}" for name in plan.objectives)],
        ["mean NIS", _nis_words(nis) if plan.is_constrained else "free"],
        ["sampler", plan.sampler],
        ["training seeds", f"{training.start} to {training.stop - 1}"],
        ["study", subject.name],
    ]
    if subject.study is not None:
        states = [trial.state for trial in subject.study.get_trials(deepcopy=False)]
        complete, early = states.count(TrialState.COMPLETE), states.count(TrialState.PRUNED)
        rows.append(["finished trials", f"{complete + early}, {early} of them ended early"])
    rows.append(["computed here with", ", ".join(f"{name} {version}" for name, version in versions().items())])
    return Section("What was done", [Table("", [], rows)])


def _nis_words(nis: Sequence[float]) -> str:
    low, high = NIS_BAND
    place = "inside" if all(low <= ratio <= high for ratio in nis) else "outside"
    found = " and ".join(f"{ratio:.3g}" for ratio in nis)
    return f"to lie between {low:g} and {high:g} of what is right; it is {found}, {place}, on the training seeds"


def _span(value: Interval) -> str:
    """A value with its 95 % interval in brackets; empty if there is no value."""
    middle, low, high = (f"{part:#.4g}".rstrip(".") for part in value)
    return "" if isnan(value.value) else f"{middle} [{low}, {high}]"
