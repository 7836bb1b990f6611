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
from numerics.plots import save_figure
from tuning.evaluation.baselines import TUNED, baselines
from tuning.evaluation.evaluate import Evaluation, check_consistency
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.sizes import SizeRow
from tuning.evaluation.versions import versions
from tuning.evaluation.worth import scaling_sentence, without_truth, worth
from tuning.reporting.consistency_figures import draw_consistency
from tuning.reporting.figures import SCORE, draw_comparison, draw_history
from tuning.reporting.page import Picture, Section, Table, Words
from tuning.reporting.search_figures import (
    FEWEST_TRIALS,
    draw_front,
    draw_importance,
    draw_sizes,
    draw_slices,
    importances,
)
from tuning.reporting.subject import Subject
from tuning.reporting.tables import errors_table
from tuning.reporting.time_figures import draw_estimates
from tuning.search.filter_types import kinds_tried, trials_of_kind
from tuning.search.objectives import NIS_BAND, find_objective
from tuning.search.plan import SIZE_SEEDS, TRAINING_SEEDS, Plan
from tuning.search.space import AUTO, Choice

MANY_TRIALS = 50


class Sketchbook(NamedTuple):
    """A folder in which pictures are drawn that a page then holds."""

    folder: Path

    def picture(self, caption: str, draw: Callable, *arguments, **options) -> Picture:
        """What a function draws that returns a figure."""
        path = save_figure(draw(*arguments, **options), self.folder / "picture.png")
        return Picture(path.read_bytes(), caption)


def advice(choice: Choice, plan: Plan, proofs: Sequence[Comparison]) -> str:
    """One sentence: what tuning is worth, the ensemble size to take, and whether the covariance is consistent.

    Of the covariance the mean NEES tells; without truth the mean NIS does.
    """
    places = [f" on {scenario.name}" if len(proofs) > 1 else "" for scenario in plan.scenarios]
    gains = [f"{worth(proof)}{place}" for proof, place in zip(proofs, places, strict=True)]
    parts = [f"Tuning {' and '.join(gains)}"]
    if "ensemble_size" in choice.numbers:
        parts.append(f"take N = {choice.numbers['ensemble_size']}")
    squares = [_squares(proof.tuned) for proof in proofs]
    if not any(isnan(mean.value) for _, mean, _ in squares):
        found = [
            f"{confidence(mean, right)}{place} (mean {name} {rounded(mean.value)} where {right:.3g} is right)"
            for (name, mean, right), place in zip(squares, places, strict=True)
        ]
        parts.append(f"the covariance is {' and '.join(found)}")
    return "; ".join(parts) + "."


def _squares(evaluation: Evaluation) -> tuple[str, Interval, float]:
    """What tells whether a covariance is consistent: its name, mean and expected value."""
    if evaluation.has_truth:
        return "NEES", evaluation.nees, len(evaluation.rmse)
    return "NIS", evaluation.nis, evaluation.expected_nis


def held_out_section(book: Sketchbook, subject: Subject, proofs: Sequence[Comparison]) -> Section:
    """Errors before and after, scenario by scenario; without truth what the innovations tell."""
    parts = []
    for scenario, proof in zip(subject.plan.scenarios, proofs, strict=True):
        if not proof.tuned.has_truth:
            parts += [Words([without_truth(scenario.name)]), errors_table(scenario, proof)]
            continue
        caption = (
            f"RMSE on {len(proof.seeds)} held-out seeds of {scenario.name} with 95 % intervals, and the bound."
        )
        title = f"{subject.choice.name} on {scenario.name}"
        said = scaling_sentence(proof)
        parts += [errors_table(scenario, proof), *([Words([said])] if said else [])]
        parts.append(book.picture(caption, draw_comparison, proof, title))
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
    parts = [book.picture(caption, draw_history, trials, f"Study {subject.name}", labels[0])]
    found = importances(study)
    if found:
        complete = [trial.state for trial in trials].count(TrialState.COMPLETE)
        caption = (
            "How much each number matters for a trial to be among the best tenth: PED-ANOVA on "
            f"{complete} complete trials{', rough on so few' if complete < MANY_TRIALS else ''}."
        )
        parts.append(book.picture(caption, draw_importance, found))
    else:
        parts.append(Words([f"Importances of the numbers need {FEWEST_TRIALS} complete trials or more."]))
    caption = (
        "First objective against each number; dashed is the best trial. Hollow: mean NIS outside its band. "
        "Crosses: pruned, at the mean of the seeds seen."
    )
    parts.append(book.picture(caption, draw_slices, trials_of_kind(trials, subject.choice.name), labels[0]))
    if subject.plan.filter == AUTO:
        parts.append(_kinds_table(trials, objectives[0]))
    if len(objectives) > 1:
        caption = "Trials by both objectives; no trial beats those of the Pareto front in both."
        parts.append(book.picture(caption, draw_front, trials, study.best_trials, labels))
    return Section(title, parts)


def _kinds_table(trials: Sequence[FrozenTrial], objective: str) -> Table:
    """Kinds of filters that the trials chose, the best first."""
    columns = ["filter", "trials", "pruned", "over budget", f"best {objective}", "µs/step"]
    rows = [
        [kind.name, f"{kind.trials}", f"{kind.pruned}", f"{kind.over_budget}"]
        + ["" if kind.value is None else f"{kind.value:.4g}{'' if kind.consistent else '*'}"]
        + ["" if kind.microseconds is None else f"{kind.microseconds:.4g}"]
        for kind in kinds_tried(trials)
    ]
    caption = "Filters that were tried, on the training seeds; the slices are those of the best"
    return Table(f"{caption}. *: mean NIS outside its band, to be chosen only where all are", columns, rows)


def sizes_section(book: Sketchbook, subject: Subject, sizes: Sequence[SizeRow]) -> Section:
    """Errors against ensemble size; how many seeds tell it of each is said where that differs."""
    first = subject.plan.scenarios[0]
    fresh = first.size_seeds(subject.plan.seed, SIZE_SEEDS)
    where = f"seeds {fresh.start} to {fresh.stop - 1} of {first.name}"
    caption = f"RMSE with 95 % intervals on {where}, which chose neither Q nor R; dashed is N."
    kept = subject.choice.numbers["ensemble_size"]
    ratios = [[f"{row.size}", f"{row.ratio.value:.4f}", f"{row.ratio.high:.4f}", f"{row.seeds}"] for row in sizes]
    said = (
        "Score over the best, paired on the same seeds; of several scenarios the largest. The smallest N whose "
        "upper end is below 1.01 is sufficient"
    )
    columns = ["N", "score over the best", "upper end of its 95 % interval", "seeds"]
    if len({row.seeds for row in sizes}) == 1:
        columns, ratios = columns[:-1], [row[:-1] for row in ratios]
    picture = book.picture(caption, draw_sizes, sizes, kept)
    return Section("Error against ensemble size", [picture, Table(said, columns, ratios)])


def run_sections(book: Sketchbook, subject: Subject, proof: Comparison) -> list[Section]:
    """One held-out run over time, and whether the covariance is consistent, both on the first scenario."""
    choice, scenario = subject.choice, subject.plan.scenarios[0]
    data, tuned = scenario.data(proof.seeds), choice.filter(scenario)
    name, before = next(iter(baselines(choice.name, scenario, subject.plan.seed, proof.default).items()))
    pair = {name: before.filter(scenario), TUNED: tuned}
    what = "Estimate and innovation, each with its" if data.states is None else "Truth, estimate and"
    caption = f"{what} 95 % band on {scenario.name}, held-out seed {proof.seeds.start}, before and after."
    scored = proof.tuned.scored or None
    picture = book.picture(caption, draw_estimates, pair, data, 0, scenario.dt, scored, sharey="row")
    sections = [Section("One run over time", [picture])]
    if filter_class(choice.name).has_covariance:
        report = check_consistency(tuned, data)
        caption = f"Checks of the tuned filter's covariance on {report.runs} held-out seeds of {scenario.name}."
        title = f"{choice.name}, tuned, on {report.runs} seeds of {scenario.name}"
        picture = book.picture(caption, draw_consistency, report, title, scored=scored)
        sections.append(Section("Is the covariance consistent?", [Words(sentences(report)), picture]))
    return sections


def facts_section(subject: Subject, nis: Sequence[float]) -> Section:
    """What was tuned, on what and with what; `nis` is the choice's on training seeds, over the channels."""
    plan = subject.plan
    training = plan.scenarios[0].training_seeds(plan.seed, TRAINING_SEEDS)
    about = [f"{one.name}: {one.about}" if one.about else one.name for one in plan.scenarios]
    rows = [
        ["filter", plan.filter if plan.filter == subject.choice.name else f"{plan.filter}: {subject.choice.name}"],
        *([["budget", f"{plan.budget:g} µs a step of one core"]] if plan.budget is not None else []),
        ["scenarios" if len(about) > 1 else "scenario", "; ".join(about)],
        ["minimised", "; ".join(f"{name}: {find_objective(name).about}" for name in plan.objectives)],
        ["mean NIS", _nis_words(nis) if plan.is_constrained else "free"],
        ["sampler", plan.sampler],
        ["training seeds", f"{training.start} to {training.stop - 1}"],
        ["study", subject.name],
    ]
    if subject.study is not None:
        states = [trial.state for trial in subject.study.get_trials(deepcopy=False)]
        complete, early = states.count(TrialState.COMPLETE), states.count(TrialState.PRUNED)
        rows.append(["finished trials", f"{complete + early}, {early} of them pruned"])
    rows.append(["computed here with", ", ".join(f"{name} {version}" for name, version in versions().items())])
    return Section("What was done", [Table("", [], rows)])


def _nis_words(nis: Sequence[float]) -> str:
    low, high = NIS_BAND
    place = "inside" if all(low <= ratio <= high for ratio in nis) else "outside"
    found = " and ".join(f"{ratio:.3g}" for ratio in nis)
    return f"to lie between {low:g} and {high:g} of what is right; it is {found}, {place}, on the training seeds"
