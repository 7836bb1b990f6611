"""`tuning.report` and `thruster report`: a page on a tuned filter, and its tables as Markdown."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import optuna
from optuna.study import StudyDirection

from filters.registry import filter_type
from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import at_least, short_repr
from thruster_env.core.files import check_target, write_whole
from tuning.api.held_out import HeldOut
from tuning.api.markers import INPUT, OUTPUT, Argument, CodeProblem, Model, Option, Preset, Progress
from tuning.api.problems import given_for, problems_of
from tuning.api.progress import console_for, working
from tuning.api.result import Result
from tuning.api.study import STUDIES, Study
from tuning.evaluation.held_out import evaluate_held_out, stored_comparison, stored_sizes, versions
from tuning.evaluation.sizes import SizeRow, ensemble_sizes, sufficient_size
from tuning.evaluation.tuned import problem_in, read_tuned, tuned_content
from tuning.likelihood.identifiability import Identifiability, identify, sentences, too_many
from tuning.problems.find import find_given
from tuning.problems.problem import Problem
from tuning.reporting.page import Section, Sketchbook, Table, Words, html_page, markdown_page, of_sizes
from tuning.reporting.search_figures import draw_sizes
from tuning.reporting.sections import Subject, advice, sections_of
from tuning.search.among_types import SIZES
from tuning.search.plan import HELD_OUT_SEEDS, SIZE_SEEDS, Plan, at_ends, nis_ratio
from tuning.search.storage import open_storage, public_url, quiet_optuna, storage_text
from tuning.search.study import chosen_of
from tuning.search.trials import best_trial, is_consistent, measure
from tuning.search.validation import choice_from


@dataclass(frozen=True)
class Report(Result):
    """The files of a report, and its summary; `open` and `Path` take it as its page.

    Attributes:
        page: for any browser.
        markdown: its tables.
        advice: the summary.
    """

    page: Path
    markdown: Path
    advice: str

    def __fspath__(self) -> str:
        return str(self.page)

    def tables(self) -> list[str]:
        """The summary and the files, for a terminal."""
        return [self.advice, f"Page: {self.page}", f"Tables: {self.markdown}"]

    def as_dict(self) -> dict[str, str]:
        """The same as plain data, as in `thruster report --json`."""
        return {"advice": self.advice, "page": str(self.page), "tables": str(self.markdown)}


def report(
    source: Annotated[str | Path | Study, Argument(INPUT, (), "FILE_OR_STUDY", str)],
    out: Annotated[str | Path | None, Option(OUTPUT, metavar="FOLDER")] = None,
    *,
    storage: Annotated[str | Path, Option(INPUT)] = STUDIES,
    problem: CodeProblem = None,
    model: Model = None,
    preset: Preset = None,
    progress: Progress = None,
) -> Report:
    """Write a page on a tuned filter, for any browser without a network, and its tables as Markdown.

    It shows errors and consistency before and after on held-out seeds, the convergence of the study, the
    importance of parameters, the error against ensemble size, one run over time with 95 % bands, and advice.

        tuning.report("tuned.json", out="report.html")

    Example: thruster report out/enkf-mismatch-seed0.json

    Args:
        source: tuned file, or name of a study in the storage. In Python also a `Study`.
        out: the page, a .html file, or a folder for it; by default beside the tuned file, or in the folder out.
        storage: storage of the study, a journal file or an Optuna storage URL; without it the page on a file omits
            the search.
        problem: the problem it was tuned on, if that is code: names in files and studies are never imported. In
            Python also a `Problem`.
        model: the model of the logs that it was tuned on, if that is code. In Python also what makes or offers
            one.
        preset: the preset with which it was tuned, by default as the tuned file names it:
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `Report`: `page`, `markdown` and `advice`.

    Raises:
        ValueError: if the source is refused, or the page cannot be written.
    """
    if isinstance(out, Study) or (out is not None and Path(out).suffix == ".json"):
        rule = "a page must be a file that ends in .html, or a folder for it (tuning.compare compares studies)"
        raise ValueError(f"{rule}, but got out={short_repr(out if isinstance(out, Study) else str(out))}")
    name = _name_of(source)
    with quiet_optuna(), working(f"reporting on {name}", console_for(progress)):
        if isinstance(source, Study):
            subject = _of_value(source)
        else:
            subject = find_subject(source, storage_text(storage), _given(source, problem, model, preset))
        page = page_of(source, name, out)
        contents = contents_of(_file_of(source), subject)
        write_whole(page, html_page(contents.title, contents.advice, contents.sections))
        text = markdown_page(contents.title, [contents.advice, *contents.results])
        write_whole(page.with_suffix(".md"), text)
    return Report(page, page.with_suffix(".md"), contents.advice)


def page_of(source: str | Path | Study, name: str, out: str | Path | None) -> Path:
    """The page: `out`, or a file of a name in the folder `out`, or beside the tuned file; checked."""
    folder = Path("out") if isinstance(source, Study) or not is_file(source) else Path(source).parent
    page = (folder if out is None else Path(out)) / f"{name}.html"
    if out is not None and Path(out).suffix == ".html":
        page = Path(out)
    for target in (page, page.with_suffix(".md")):
        check_target(target)
    return page


def _name_of(source: Any) -> str:
    if isinstance(source, Study):
        return source.name
    if not isinstance(source, str | Path):
        raise ValueError(
            f"a report must be of a Study, a tuned file or the name of a study, but got {short_repr(source)}"
        )
    return Path(source).stem if is_file(source) else str(source)


def _file_of(source: str | Path | Study) -> str | None:
    """What the page calls the tuned file; None if there is none."""
    if isinstance(source, Study):
        return None if source.file is None else str(source.file)
    return str(source) if is_file(source) else None


def _given(source: str | Path, problem: Any, model: Any, preset: str | Path | None) -> Sequence[Problem]:
    """What the user gives of the problems that a file or a study names."""
    if is_file(source) and Path(source).is_file():
        return given_for(source, problem, model, preset)
    return [] if problem is None else problems_of(problem)


def _of_value(study: Study) -> Subject:
    """A study that is at hand, as its tuned file would have it."""
    plan, result = study.plan, study.result
    content = json.loads(json.dumps(tuned_content(plan, result, study.comparisons, study.name, study.method)))
    trials = optuna.create_study(
        study_name=study.name, directions=[StudyDirection.MINIMIZE] * len(plan.objectives)
    )
    trials.add_trials(study.trials)
    consistent, seeds = plan.is_constrained and bool(result.consistent), len(study.comparison.seeds)
    stored = content, content["ensemble_sizes"], content["choice"], kept_nis(content, plan)
    return Subject(study.name, plan, study.choice, trials, seeds, True, consistent, *stored)


class Contents(NamedTuple):
    """All results of a study, ready for a page."""

    title: str
    advice: str
    sections: list[Section]
    results: list[Table | str]  # tables and sentences, also for Markdown


def sizes_section(book: Sketchbook, subject: Subject, sizes: Sequence[SizeRow]) -> Section:
    """Errors against ensemble size, with the number of seeds of each if they differ."""
    first = subject.plan.scenarios[0]
    fresh = first.size_seeds(subject.plan.seed, SIZE_SEEDS)
    where = f"{first.seed_word} {fresh.start} to {fresh.stop - 1} of {first.name}"
    caption = f"RMSE with 95 % intervals on {where}, which chose neither Q nor R; dashed is N."
    size = subject.choice.numbers["ensemble_size"]
    ratios = [[f"{row.size}", f"{row.ratio.value:.4f}", f"{row.ratio.high:.4f}", f"{row.seeds}"] for row in sizes]
    explanation = (
        f"Score relative to the best, paired on the same {first.seed_word}; the largest of several scenarios. "
        "The smallest N whose upper end is below 1.01 is sufficient"
    )
    columns = ["N", "score over the best", "upper end of its 95 % interval", first.seed_word]
    if len({row.seeds for row in sizes}) == 1:
        columns, ratios = columns[:-1], [row[:-1] for row in ratios]
    picture = book.picture(draw_sizes(sizes, size), caption, of_sizes(sizes, size))
    return Section("Error against ensemble size", [picture, Table(explanation, columns, ratios)])


def contents_of(file: str | None, subject: Subject) -> Contents:
    """The contents of a page on a study.

    Held-out metrics and the table of ensemble sizes come from the file or the study if they were made from the
    same problems by the same versions of packages; otherwise they are recomputed. `verify` always recomputes.
    """
    plan, choice = subject.plan, subject.choice
    data = plan.training_data()
    sizes: Sequence[SizeRow] = []
    if filter_type(choice.name).has_ensemble:
        kept_rows = stored_sizes(subject.sizes, choice, plan)
        sizes = ensemble_sizes(choice, plan, data, subject.consistent) if kept_rows is None else kept_rows
    if sizes and not subject.chosen:
        choice = choice.with_size(sufficient_size(sizes, subject.consistent))
        subject = subject._replace(choice=choice)
    stored = [stored_comparison(subject.content, choice, scenario) for scenario in plan.scenarios]
    comparisons = [
        evaluate_held_out(choice, scenario, plan.seed, subject.seeds) if comparison is None else comparison
        for comparison, scenario in zip(stored, plan.scenarios, strict=True)
    ]
    title = f"{choice.name} tuned on {', '.join(_short(scenario.name) for scenario in plan.scenarios)}"
    known = identify(choice, plan.scenarios, data, plan.space())
    identified = at_ends(choice, plan)
    identified += sentences(known) if known else too_many(choice, plan.space())
    nis = subject.nis or [nis_ratio(values) for values in measure(choice, plan, data)]
    results = [
        HeldOut(choice, scenario, comparison, seed=plan.seed, forget=plan.forget).tables()
        for scenario, comparison in zip(plan.scenarios, comparisons, strict=True)
    ]
    determined = [known_table(known)] if known else []
    words = [Words(identified)] if identified else []
    book = Sketchbook()
    of_data = [Section("What the data determine", [*determined, *words])] if determined or words else []
    on_sizes = [sizes_section(book, subject, sizes)] if sizes else []
    sections = sections_of(book, subject, comparisons, results, of_data, on_sizes, file, nis)
    summary = advice(choice, plan, comparisons, subject.validation)
    return Contents(title, summary, sections, [*sum(results, []), *determined, *identified])


def _short(name: str) -> str:
    """A problem's name in a title: for a file only its name."""
    return Path(name).stem if name.endswith(".toml") else name


def known_table(result: Identifiability) -> Table:
    """The parameters as the innovations determine them."""
    identified = result.identified & (not result.tails)
    columns = result.names, result.tuned, result.most_likely, result.factors, identified
    rows = [
        [name, f"{tuned:.4g}", f"{best:.4g}", f"{factor:.3g}" if known else "", "yes" if known else "no"]
        for name, tuned, best, factor, known in zip(*columns, strict=True)
    ]
    if result.tails:
        rows = [row[:3] for row in rows]
        return Table("Parameters by maximum likelihood", ["", "tuned", "maximum likelihood"], rows)
    header = ["", "tuned", "maximum likelihood", "known within a factor of", "determined"]
    return Table(
        "Parameters determined by the innovations of the training runs, with 95 % probability", header, rows
    )


def find_subject(source: str | Path, storage: str, problems: Sequence[Problem] = ()) -> Subject:
    """The subject of a report.

    Args:
        source: a tuned file (what ends in .json, or is a file), or the name of a study.
        storage: where the study is; a tuned file may come without.
        problems: what it is of, where that is code: nothing that a file or a study names is imported.

    Raises:
        ValueError: if the tuned file is refused, or there is no such study or none of its trials is complete.
    """
    return (_of_file if is_file(source) else _of_study)(str(source), storage, problems)


def is_file(source: str | Path) -> bool:
    """Whether a source stands for a tuned file."""
    return Path(source).suffix == ".json" or Path(source).is_file()


def _of_file(path: str, storage: str, problems: Sequence[Problem]) -> Subject:
    content, (choice, scenario, _) = read_tuned_file(path), read_tuned(path, problems)
    name, plan = (
        str(content["study"].get("name")),
        _plan(content["study"], path, partial(problem_in, content, path=path, problems=problems)),
    )
    study = _load(name, storage)
    if study is not None and study.user_attrs.get("identity") != plan.identity:
        study = None  # another study of the same name
    try:
        first, beyond = content["held_out"][scenario.name]["seeds"]
        count = at_least("the number of held-out seeds", beyond - first, 2)
    except (KeyError, TypeError):
        raise ValueError(f"a tuned file must contain its held-out seeds, but {path} does not") from None
    consistent = plan.is_constrained and bool(content["study"].get("any_trial_consistent"))
    stored = content if content.get("digest") == plan.scenarios[0].digest else {}
    sizes, nis = content.get("ensemble_sizes"), kept_nis(stored, plan)
    met = content.get("choice")
    return Subject(name, plan, choice, study, count, True, consistent, stored, sizes, met, nis)


def kept_nis(content: Mapping, plan: Plan) -> tuple[float, ...]:
    """The mean NIS on the training seeds in a tuned file; nothing if it was made with other packages."""
    ratios = content.get("study", {}).get("mean_nis") if content.get("made_with") == versions() else None
    if not isinstance(ratios, list) or len(ratios) != len(plan.scenarios):
        return ()
    return tuple(ratios) if all(isinstance(ratio, float) for ratio in ratios) else ()


def _of_study(name: str, storage: str, problems: Sequence[Problem]) -> Subject:
    study = _load(name, storage)
    if study is None:
        where = public_url(storage)
        raise ValueError(f"a report must be of a tuned file or of a study in {where}, but got {name!r}")
    where = f"study {name!r}"
    plan = _plan(study.user_attrs.get("identity"), where, partial(find_given, problems=problems, where=where))
    best = best_trial(study.get_trials(deepcopy=False))
    if best is None:
        raise ValueError(f"a study must have a complete trial for a report, but {name!r} has none")
    choice, met = plan.choice_of(best.params), chosen_of(study)
    if met is not None:
        contender = next(contender for contender in met["met"] if contender["name"] == met["chosen"])
        choice = choice_from(contender["choice"])
    consistent = plan.is_constrained and is_consistent(best)
    chosen, sizes = len(plan.objectives) > 1 or met is not None, study.user_attrs.get(SIZES)
    return Subject(name, plan, choice, study, HELD_OUT_SEEDS, chosen, consistent, sizes=sizes, validation=met)


def _load(name: str, storage: str) -> optuna.Study | None:
    """A study by name, None if it does not exist; no storage is created."""
    if "://" not in storage and not Path(storage).is_file():
        return None
    try:
        return optuna.load_study(study_name=name, storage=open_storage(storage))
    except KeyError:
        return None


def _plan(identity, where: str | Path, find: Callable[[str], Problem]) -> Plan:
    """The plan of an identity, its scenarios found by name."""
    try:
        scenarios = tuple(find(name) for name in identity["scenarios"])
        options = {
            name: identity[name] for name in ("filter", "consistent", "sampler", "hold_r", "budget", "full_q")
        }
        options |= {name: identity[name] for name in ("full_r", "worst", "forget") if name in identity}
        options |= {"objectives": tuple(identity["objectives"]), "where": tuple(identity.get("where", ()))}
        plan = Plan(scenarios=scenarios, seed=at_least("seed", identity["seed"], 0), **options)
    except (KeyError, TypeError):
        raise ValueError(f"a report needs the plan of the study, but {where} has {short_repr(identity)}") from None
    return plan.checked()
