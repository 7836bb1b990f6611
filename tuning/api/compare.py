"""`tuning.compare` and `thruster compare`: filters side by side on problems, on seeds that no study saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from filters.consistency.nees import Interval, slightly
from filters.estimators.foreign import label_of
from filters.filter import Filter
from filters.logs.findings import colour_of
from filters.registry import FILTERS, filter_type
from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import at_least, short_repr
from thruster_env.core.files import panels
from thruster_env.core.parallel import task_map
from thruster_env.core.text_tables import TITLE, Table, verbatim
from tuning.api.evaluate import NOMINAL
from tuning.api.held_out import cells_of, cells_of_interval
from tuning.api.markers import (
    FILTER,
    INPUT,
    READ,
    Argument,
    Augment,
    ExecutorOption,
    Option,
    Preset,
    ProblemOption,
    Progress,
    Seed,
)
from tuning.api.problems import given_for, is_filter, problems_of
from tuning.api.progress import console_for, row_bar
from tuning.api.result import Result, drawn, frame, number, plain_data
from tuning.api.study import DEFAULT_FILTER, Study, is_own, user_choice
from tuning.api.tune import MOST_TRIALS
from tuning.evaluation.baselines import OWN
from tuning.evaluation.compare import (
    DEFAULT_FILTERS,
    OF_FILE,
    OF_FILTER,
    STUDY,
    STUDY_TRIALS,
    Contender,
    Leaderboard,
    Row,
    contender,
    fitting,
    sized,
    winners,
)
from tuning.evaluation.compare import compare as compare_all
from tuning.evaluation.evaluate import restart_sentences
from tuning.evaluation.tuned import read_choice, read_tuned, suited_to
from tuning.problems.assumed import Unknowns, constants_in, suited, unknowns_of
from tuning.problems.find import built_in
from tuning.problems.problem import Problem
from tuning.reporting.tables import as_json, report
from tuning.search.plan import HELD_OUT_SEEDS
from tuning.search.space import Choice
from tuning.search.storage import quiet_optuna

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

SIZE = "ensemble_size (--ensemble-size)"
INTERRUPTED = "Interrupted: these are the rows that were done."


@dataclass(frozen=True, eq=False, repr=False)
class FilterComparison(Result):
    """Filters on one problem or several, in the order in which they were given.

    Attributes:
        boards: a `Leaderboard` for each problem: seeds, bound and rows.
        seed: of the study to which the held-out seeds belong.
        interrupted: whether Ctrl-C ended it; the rows are the finished ones.
        left_out: by label, why a filter could not run.
        knows: the Q and R of named filters that were asked for.
    """

    boards: tuple[Leaderboard, ...]
    seed: int = 0
    interrupted: bool = False
    left_out: Mapping[str, str] = field(default_factory=dict)
    knows: str | None = None

    @property
    def problems(self) -> tuple[Problem, ...]:
        """The problems."""
        return tuple(board.scenario for board in self.boards)

    @property
    def filters(self) -> tuple[str, ...]:
        """Labels of the filters; the others are compared with the first."""
        return tuple(row.label for row in self.boards[0].rows)

    def ranked(self, problem: int = 0) -> list[str]:
        """Labels of the filters on a problem, by its index, the best one (without truth the likeliest) first."""
        return [row.label for row in sorted(self.boards[problem].rows, key=_rank)]

    def sentences(self) -> list[str]:
        """The filters that are significantly better or worse than the first one on each problem, and restarts."""
        statements = []
        for board in self.boards:
            statements += [winners(board), *restart_sentences({row.label: row.evaluation for row in board.rows})]
        return statements

    def to_frame(self) -> pandas.DataFrame:
        """A row for each filter and problem: errors, score and its ratio to the first filter's, consistency, cost.

        Raises:
            ValueError: if pandas is not installed.
        """
        pairs = [(board, row) for board in self.boards for row in board.rows]
        columns: dict[str, list] = {"problem": [board.scenario.name for board, _ in pairs]}
        columns["filter"] = [row.label for _, row in pairs]
        cells: list[dict[str, Any]] = []
        for board, row in pairs:
            verdict = "" if row is board.rows[0] else row.verdict  # the first is compared with itself
            cells.append(cells_of(row.evaluation) | cells_of_interval("score over first", row.score_ratio))
            cells[-1] |= {"log-likelihood less first": row.likelihood_gain.value}
            cells[-1] |= {
                "median NEES": row.evaluation.median_nees,
                "us/step": row.microseconds,
                "verdict": verdict,
            }
        for name in dict.fromkeys(name for values in cells for name in values):
            columns[name] = [values.get(name, np.nan) for values in cells]
        return frame(columns)

    def plot_scores(self) -> Figure:
        """Score of each filter with 95 % interval, a panel per problem; without truth the log-likelihood gained.

        Hollow points do not differ significantly from the first.
        """
        count = max(len(board.rows) for board in self.boards)
        figure, axes = panels(len(self.boards), 3, (5.2, 0.9 + 0.38 * count), extra=0.3)
        for axis, board in zip(axes, self.boards, strict=True):
            _draw(axis, board)
        return drawn(figure)

    def __repr__(self) -> str:
        parts = []
        for board in self.boards:
            ranking = [f"{row.label} {_figure(row)}" for row in sorted(board.rows, key=_rank)]
            parts.append(f"{board.scenario.name}: {', '.join(ranking)}")
        ended = ", interrupted" if self.interrupted else ""
        return f"FilterComparison({'; '.join(parts)}{ended})"

    def tables(self) -> list[Table | str]:
        """The tables of each problem and a sentence on the winner, for a terminal."""
        ended = [INTERRUPTED] if self.interrupted else []
        return [*(part for board in self.boards for part in report(board)), *left_out_lines(self.left_out), *ended]

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data, as in `thruster compare --json`."""
        data = {"seed": self.seed, "knows": self.knows, "interrupted": self.interrupted, "left_out": self.left_out}
        return plain_data({**data, **as_json(list(self.boards))})

    def figures(self) -> dict[str, Figure]:
        """Scores of all filters."""
        return {"Scores with 95 % intervals": self.plot_scores()}


def left_out_lines(left_out: Mapping[str, str]) -> list[str]:
    """A line for each filter that could not run, and why."""
    return [f"{label} is left out: {why}" for label, why in left_out.items()]


def _rank(row: Row) -> float:
    value = row.evaluation.score.value if row.evaluation.has_truth else -row.evaluation.log_likelihood
    return np.inf if np.isnan(value) else value


def _figure(row: Row) -> str:
    evaluation = row.evaluation
    return number(evaluation.score.value if evaluation.has_truth else evaluation.log_likelihood)


def _verdict(row: Row) -> str:
    slight = slightly(row.score_ratio)
    return f"{row.verdict} by {slight}" if slight else row.verdict


def _draw(axis: Any, board: Leaderboard) -> None:
    truth = board.rows[0].evaluation.has_truth
    for i, row in enumerate(board.rows):
        value: Interval = row.evaluation.score if truth else row.likelihood_gain
        if np.isnan(value.value):
            continue
        colour = colour_of(row.filter_name)
        face = "white" if row.verdict == "tie" and i else colour
        axis.plot([value.low, value.high], [-i, -i], "|-", color=colour, linewidth=1.4)
        axis.plot(value.value, -i, "o", color=colour, markerfacecolor=face, markersize=6)
    axis.set_yticks([-i for i in range(len(board.rows))], [verbatim(row.label) for row in board.rows])
    axis.set_ylim(0.6 - len(board.rows), 0.6)
    axis.grid(axis="y", visible=False)
    gained = f"log L of a run less that of {verbatim(board.rows[0].label)}"
    axis.set_xlabel("score: mean RMSE over scale [-]" if truth else gained)
    axis.set_title(verbatim(board.scenario.name, most=TITLE), fontsize=11)


PARTICLES = "pf"
MOST_STATES = 6  # to which a thousand particles are spread by default: the number needed grows exponentially


def default_filters(problems: Sequence[Problem]) -> tuple[list[str], dict[str, str]]:
    """The filters of a comparison in which none is named, and by label why one is not among them."""
    n, problem = max(((len(problem.quantities.states), problem.name) for problem in problems), default=(0, ""))
    if n <= MOST_STATES:
        return list(DEFAULT_FILTERS), {}
    why = f"by default particles are for up to {MOST_STATES} states, but {problem} has {n} (--filter {PARTICLES})"
    return [name for name in DEFAULT_FILTERS if name != PARTICLES], {PARTICLES: why}


def compare(
    filters: Annotated[
        Any, Argument(FILTER, ("--filter",), "FILE", list[str], choices=FILTERS, file=READ)
    ] = DEFAULT_FILTERS,
    problem: Annotated[
        Any, ProblemOption(INPUT, ("--problem", "--scenario"), type=list[str], choices="problems", file=READ)
    ] = None,
    *,
    seeds: int = HELD_OUT_SEEDS,
    knows: Annotated[str | None, Option(FILTER)] = None,
    trials: Annotated[int | None, Option(FILTER)] = None,
    augment: Augment = (),
    ensemble_size: Annotated[
        int | Mapping[str, int] | Sequence[str] | None, Option(FILTER, metavar="[FILTER=]N", type=list[str])
    ] = None,
    preset: Preset = None,
    seed: Seed = 0,
    executor: ExecutorOption = None,
    progress: Progress = None,
) -> FilterComparison:
    """Rank filters on problems by errors, consistency and cost, paired with the first one on the same seeds.

    All filters see the same truth, inputs and measurements. A filter is better or worse than the first one if the
    paired 95 % interval of the ratio of their scores excludes 1; without truth, if that of the difference of their
    log-likelihoods excludes 0. Named filters that do not accept a problem's model are left out, with the reason.
    Ctrl-C keeps finished rows.

        comparison = tuning.compare(["kf", "ekf", "enkf"], "mismatch", seeds=50)
        comparison.to_frame()
        comparison.plot_scores()

    Example: thruster compare --filter ekf --filter ekf-robust --filter pf --scenario outliers --scenario ambient

    Example: thruster compare --filter ekf --augment ambient_velocity --scenario ambient

    Args:
        filters: files of `thruster tune` and `thruster train-estimator`, names of filters, or module:object for an
            estimator of another package; the others are compared with the first. By default ekf, enkf and, for up
            to 6 states, pf. In Python also `Study`s, other packages' estimators, or your own: a filter such
            as `make_filter("ekf", model)` or a model with its Q and R, in a list, or in a mapping from the labels
            of their rows.
        problem: name of a problem; may be repeated; by default that of the first tuned file, or nominal. In Python
            as for `tuning.tune`.
        seeds: number of held-out seeds.
        knows: the Q and R of named filters: true (the plant's own, the oracle), scaled (the scaled default),
            untuned (the rule of thumb), given (the model's own), noise (noise estimation) or study (the best on
            the training seeds of a study of 20 trials and all of these but the oracle; ensemble sizes are not
            tuned). Default: true; study where the model is wrong (its residuals on true states are not white with
            the plant's Q and R), except for rows that estimate further constants; scaled where the plant's Q and R
            are unknown, or, without a scaled default, the first available of given, noise and untuned.
        trials: number of trials of the study if `knows` is study, which it implies.
        augment: give each named filter a second row that also estimates this constant of its model, such as
            ambient_velocity, with prior deviation STD and a random walk of WALK per step; may be repeated. In
            Python also by name an `Unknown` or (std, walk).
        ensemble_size: of all filters or of one; 30 by default, 1000 for particles; may be repeated. In Python a
            number, or numbers by name.
        preset: the problems of another thruster.
        seed: seed of all randomness; the same seed gives the same results.
        executor: where parts run: in N processes, in those of `mpirun`, or on a Dask scheduler's workers; in this
            process by default. In Python also any `concurrent.futures.Executor`.
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `FilterComparison`: `to_frame()`, `plot_scores()`, `sentences()`.

    Raises:
        ValueError: states the rule and the value.
        KeyboardInterrupt: after Ctrl-C before any row is done.
    """
    if trials is not None:
        trials = at_least("trials", trials, 1, MOST_TRIALS)
        if knows not in (None, STUDY):
            raise ValueError(f"knows must be left out, or {STUDY!r}, with trials, but got {short_repr(knows)}")
    labels = list(filters) if isinstance(filters, Mapping) else []
    asked = list(filters.values()) if labels else list(filters) if isinstance(filters, list | tuple) else [filters]
    for name in asked:
        if isinstance(name, str) and name in built_in():
            raise ValueError(
                f"a filter must be a name or a file, but got the problem {name}: use problem (--problem)"
            )
    problems = problems_of(_default(asked) if problem is None else problem, preset)
    for file in asked:
        if isinstance(file, str | Path) and not is_filter(file):
            for each in problems:
                read_choice(Path(file), suited_to(Path(file), each))  # a clear error for another plant's file
    left_out: dict[str, str] = {}
    if filters is DEFAULT_FILTERS:
        asked, left_out = default_filters(problems)
    accepted, unfit = without_unfit(asked, problems)
    pairs = zip(labels, asked, strict=False)
    labels = [label for label, filter_ in pairs if not _is_named(filter_) or filter_ in accepted]
    sizes, chosen = _sizes(ensemble_size), knows if trials is None else STUDY
    arguments = chosen, unknowns_of(augment or {}), sizes, seed, trials or STUDY_TRIALS
    contenders = contenders_of(accepted, *arguments)
    if labels:
        groups = [contenders_of([filter_], *arguments) for filter_ in accepted]
        contenders = [
            contender._replace(label=contender.label.replace(group[0].label, str(label), 1))
            for label, group in zip(labels, groups, strict=True)
            for contender in group
        ]

    def held_out(problem: Problem) -> range:
        return problem.held_out_seeds(seed, seeds)

    for each in problems:
        held_out(each)  # a clear error before any filter runs
    total, console = len(contenders) * len(problems), console_for(progress)
    # Around all threads of an executor: the first that is done would else let Optuna talk in the others.
    with quiet_optuna(), task_map(executor) as tasks, row_bar(total, console) as on_row:
        boards, interrupted = compare_all(contenders, problems, held_out, on_row, tasks)
    return FilterComparison(tuple(boards), seed, interrupted, left_out | unfit, knows)


def _sizes(argument: int | Mapping[str, int] | Sequence[str] | None) -> dict[str | None, int]:
    """Ensemble sizes by name, under None that of all other filters, also from texts [FILTER=]N."""
    if isinstance(argument, Mapping):
        return {name: size for name, size in argument.items() if size is not None}
    if isinstance(argument, list | tuple):
        parts = [text.rpartition("=") for text in argument]
        return {name if equals else None: at_least(SIZE, number, 2) for name, equals, number in parts}
    return {None: argument} if isinstance(argument, int) else {}


def without_unfit(filters: Sequence[Any], problems: Sequence[Problem]) -> tuple[list[Any], dict[str, str]]:
    """The filters without named ones that do not accept a problem's model, and the reasons by label."""
    named = [filter_ for filter_ in filters if _is_named(filter_)]
    accepted, left_out = fitting(named, problems)
    if not accepted and len(named) == len(filters):  # not even a tuned one
        raise ValueError(next(iter(left_out.values()), "a comparison must have at least one filter, but got none"))
    return [filter_ for filter_ in filters if not _is_named(filter_) or filter_ in accepted], left_out


def contenders_of(
    filters: Sequence[Any],
    knows: str | None,
    unknown: Unknowns,
    sizes: Mapping[Any, int],
    seed: int,
    trials: int = STUDY_TRIALS,
) -> list[Contender]:
    """The filters to compare: first tuned files and studies, then named filters.

    Args:
        filters: names, paths of tuned files, `Study`s or estimators.
        knows: the Q and R of named filters; None for the default.
        unknown: constants that each of these also estimates in a second row.
        sizes: ensemble size by name; under None that of all others.
        seed: of the study whose training runs scale the scaled default.
        trials: of the study by which filters are known.
    """
    for name, members in sizes.items():
        if name is not None and not filter_type(name).has_ensemble:
            raise ValueError(f"{SIZE} must be for a filter with an ensemble, but got {name}: {members}")
        at_least(SIZE, members, 2)

    def size_of(name: Any) -> int | None:
        return sizes[name] if name in sizes else sizes.get(None)

    out: list[Contender] = []
    for filter_ in filters:
        if isinstance(filter_, Study):
            choice = sized(filter_.choice, size_of(filter_.choice.name))
            label = f"{label_of(choice.name)} tuned"
            suit = partial(suited, constants=constants_in(filter_.problem))
            out.append(Contender(_new(label, out), partial(_same, choice), knows=OF_FILE, suit=suit))
        elif is_own(filter_):
            label = f"{filter_.name if isinstance(filter_, Filter) else DEFAULT_FILTER} {OWN}"
            source = "" if isinstance(filter_, Filter) and not filter_.has_covariance else OF_FILTER
            out.append(Contender(_new(label, out), partial(user_choice, filter_), knows=source))
        elif not is_filter(filter_):
            size = size_of(read_tuned_file(filter_)["filter"]["name"])
            chosen, suit = partial(_from_file, Path(filter_), size), partial(suited_to, Path(filter_))
            out.append(Contender(_new(Path(filter_).stem, out), chosen, knows=OF_FILE, suit=suit))
        else:
            kind = filter_type(filter_)
            size = size_of(filter_) if kind.has_ensemble and not kind.is_foreign else None
            out.append(contender(filter_, knows, None, seed, trials, ensemble_size=size))
            if unknown and kind.has_covariance:
                out.append(contender(filter_, knows, unknown, seed, trials, ensemble_size=size))
    return out


def _is_named(filter_: Any) -> bool:
    return not isinstance(filter_, Study) and not is_own(filter_) and is_filter(filter_)


def _default(filters: Sequence[Any]) -> Any:
    """The problem where none is named: that of the first tuned file or study, or nominal."""
    for filter_ in filters:
        if isinstance(filter_, Study):
            return list(filter_.problems)
        if not is_own(filter_) and not is_filter(filter_):
            return read_tuned(filter_, given_for(filter_))[1]
    return NOMINAL


def _from_file(file: Path, size: int | None, problem: Problem) -> Choice:
    return sized(read_choice(file, problem), size)


def _same(choice: Choice, problem: Problem) -> Choice:
    return choice


def _new(label: str, before: Sequence[Contender]) -> str:
    """A label that none has before."""
    labels = [contender.label for contender in before]
    if label not in labels:
        return label
    return next(
        text for text in (f"{label} {number}" for number in range(2, len(labels) + 3)) if text not in labels
    )
