"""Tuning on problems as users have them: whether a tuned filter is ever worse than what they had before.

Each filter is tuned on each problem of a panel. Results are stored in a file per case, and an existing one is not
computed again. Holm's procedure finds the significant losses among all cases.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

import tuning
from filters.consistency.nees import Interval, pooled_mean, slightly
from thruster_env.core.files import write_whole
from thruster_env.core.text_tables import Table, markdown_table
from tuning.api.markers import INPUT, OUTPUT, RUNS, Option
from tuning.api.result import Printed
from tuning.api.tune import short_name
from tuning.cli.output import progress_of
from tuning.evaluation.baselines import ORACLE, TUNED
from tuning.evaluation.evaluate import Evaluation, score_ratio
from tuning.problems.find import find_problem
from tuning.problems.problem import Problem

PANEL_NAMES = """altitude battery chain compartments geared_motor heat_exchanger lateral lidar lorenz63 pendulum
range_bearing reactor"""
PANEL = tuple(f"tests.users.{name}:problem" for name in PANEL_NAMES.split())
FILTERS = ("ekf", "ukf", "enkf", "ekf-robust")
TRIALS = 50
QUICK_TRIALS = 4
KINDS: dict[str, type] = {  # of a file's entries
    **dict.fromkeys(("problem", "filter", "gave_way", "error"), str),
    **dict.fromkeys(("score", "nis", "seconds"), float),
    "restarts": int,
}
OnCase = Callable[[str, int, int], None]  # what begins, cases that are done, all cases
LEVEL = 0.05  # of a whole table: the chance that Holm's procedure calls any pair worse where none is
MARK = "!"  # of a ratio that is significantly above 1
FIRST = ("given", "scaled default", "rule of thumb", "noise estimation")  # the order of columns; others follow
TAIL = 0.025  # of a 95 % interval on one side
NOT_ON_PAGE = "ukf", "ekf-robust", "over rule of thumb", "over oracle"  # of the table
RESULTS = Path("out") / "users"


class Panel(NamedTuple):
    """What is tuned on what."""

    problems: tuple[str, ...] = PANEL
    filters: tuple[str, ...] = FILTERS
    trials: int = TRIALS
    seed: int = 0


QUICK = Panel(PANEL[:2], ("ekf",), QUICK_TRIALS)


class Paired(NamedTuple):
    """A tuned filter beside one baseline on the held-out seeds."""

    ratio: Interval  # score of the tuned filter over the baseline's, paired by run
    chance: float  # one-sided p-value of "the tuned filter is no worse"


class Case(NamedTuple):
    """A filter that was tuned on a problem, or the error that it ended in."""

    problem: str
    filter: str
    score: float  # mean over states of RMSE over scale, held out
    nis: float  # mean NIS over the number of channels
    restarts: int
    gave_way: str  # the baseline that the study took in place of its best trial; empty where it took a trial
    baselines: Mapping[str, Paired]
    seconds: float
    error: str = ""


def found_problems(names: Sequence[str]) -> list[Problem]:
    """The problems of a panel, by "module:object" or by name.

    Raises:
        ValueError: for a problem that is not there, or has no truth to be judged by.
    """
    problems = []
    for name in names:
        try:
            problem = find_problem(name)
        except ValueError as error:
            if name not in PANEL:
                raise
            raise ValueError(
                f"the panel's problems must be found in tests/users of the working folder, a checkout of the "
                f"project (others by --problem), but {error}"
            ) from error
        if problem.scale is None:
            raise ValueError(f"a problem of the panel must have true states, but {name} has none")
        problems.append(problem)
    return problems


def run_panel(panel: Panel, folder: Path, on_case: OnCase = lambda text, done, count: None) -> list[Case]:
    """Tune every filter of a panel on every problem, and compare it with its baselines on held-out seeds.

    A case whose file is in the folder is not done again, unless its problem, trials or seed are others. Ctrl-C
    loses the case that is going on.

    Args:
        panel: what is tuned on what.
        folder: for a file per case.
        on_case: called before each case.

    Raises:
        ValueError: for problems that cannot be found, or a damaged file.
        KeyboardInterrupt: on Ctrl-C.
    """
    problems = found_problems(panel.problems)
    pairs = [(problem, name) for problem in problems for name in panel.filters]
    cases = []
    for done, (problem, name) in enumerate(pairs):
        on_case(f"{name_of(problem)}, {name}", done, len(pairs))
        key = {"problem": problem.digest, "filter": name, "trials": panel.trials, "seed": panel.seed}
        file = folder / f"{name_of(problem)}-{name}-{panel.trials}-seed{panel.seed}.json"
        case = _read(file, key)
        if case is None:
            case = tuned_case(problem, name, panel.trials, panel.seed)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(file, json.dumps({"of": key, **case._asdict()}, indent=1))
        cases.append(case)
    return cases


def tuned_case(problem: Problem, name: str, trials: int, seed: int) -> Case:
    """Tune a filter on a problem, and hold it against its baselines; an error of either is kept in the case."""
    started = time.perf_counter()
    try:
        study = tuning.tune(problem, filter=name, trials=trials, seed=seed, progress=False)
    except ValueError as error:
        nothing = float("nan")
        seconds = time.perf_counter() - started
        return Case(name_of(problem), name, nothing, nothing, 0, "", {}, seconds, str(error))
    if study.interrupted:
        raise KeyboardInterrupt
    validation = getattr(study.result, "validation", None)
    gave_way = validation.chosen if validation is not None and validation.gave_way else ""
    seconds = time.perf_counter() - started
    return compared(name_of(problem), name, study.held_out.comparison.evaluations, seconds, gave_way)


def compared(
    problem: str, name: str, evaluations: Mapping[str, Evaluation], seconds: float, gave_way: str = ""
) -> Case:
    """A case from the evaluations of the tuned filter and its baselines on the same held-out seeds."""
    tuned = evaluations[TUNED]
    paired = {
        label: Paired(score_ratio(tuned, other), chance_if_no_worse(tuned, other))
        for label, other in evaluations.items()
        if label != TUNED
    }
    nis = tuned.nis.value / tuned.expected_nis
    return Case(problem, name, tuned.score.value, nis, tuned.divergences, gave_way, paired, seconds)


def name_of(problem: Problem) -> str:
    """A problem's name in tables and files: "geared_motor" of "tests.users.geared_motor:problem"."""
    module, _, what = problem.name.partition(":")
    return module.rpartition(".")[2] if what == "problem" else short_name(problem)


def _read(file: Path, key: Mapping) -> Case | None:
    """The case of a file; None unless there is one of the same problem, filter, trials and seed."""
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content.pop("of") != key:
            return None
        paired = {
            name: Paired(Interval(*map(float, ratio)), float(chance))
            for name, (ratio, chance) in content.pop("baselines").items()
        }
        entries: dict[str, Any] = {name: KINDS[name](value) for name, value in content.items()}
        return Case(baselines=paired, **entries)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file} must be a whole file of results, but cannot be read: {error}") from None


def chance_if_no_worse(a: Evaluation, b: Evaluation) -> float:
    """One-sided p-value: the chance of a ratio of scores a/b as large as this one, if a is no worse than b.

        s = mean_i sqrt(m_i)/c_i,    m_i mean squares pooled over runs, c_i the scale of state i

    The influence of one run on s is linear in that run's squares, so the standard error of log(s_a/s_b) is that of
    a mean of paired differences (the delta method). Student's t gives a p-value at any level, where a bootstrap
    ends at one over the number of its resamples. The p-value is 1 if both made the same errors in each run.

    Args:
        a: a filter's errors on some seeds.
        b: the other one's on the same seeds.

    Raises:
        ValueError: if there are fewer than two runs.

    Source: B. Efron, R. Tibshirani (1993), An Introduction to the Bootstrap.
    """
    if len(a.mean_squares) < 2:
        raise ValueError(f"a p-value needs at least two runs, but got {len(a.mean_squares)}")
    if np.array_equal(a.mean_squares, b.mean_squares):
        return 1.0
    (log_a, parts_a), (log_b, parts_b) = _influences(a), _influences(b)
    difference = parts_a - parts_b
    error = difference.std(ddof=1) / math.sqrt(len(difference))
    if not (math.isfinite(log_a - log_b) and error > 0):
        return 0.0 if log_a > log_b else 1.0
    from scipy.stats import t as student  # takes half a second

    return float(student.sf((log_a - log_b) / error, len(difference) - 1))


def holm(chances: Sequence[float], level: float = LEVEL) -> list[bool]:
    """Which of many p-values are significant together, by Holm's procedure.

    With m of them in increasing order, p_(1), ..., p_(m), those before the first with p_(k) > level/(m + 1 - k)
    are. Whatever their dependence, the chance that any is called so wrongly is at most `level`.

    Source: S. Holm (1979), "A simple sequentially rejective multiple test procedure", Scand. J. Statistics 6.
    """
    significant, count = [False] * len(chances), len(chances)
    for rank, index in enumerate(np.argsort(chances, kind="stable")):
        if chances[index] > level / (count - rank):
            break
        significant[index] = True
    return significant


def _influences(evaluation: Evaluation) -> tuple[float, np.ndarray]:
    """Logarithm of the score, and the influence of each run on it, (B,)."""
    counted = np.isfinite(evaluation.scale)
    squares, scale = evaluation.mean_squares[:, counted], evaluation.scale[counted]
    means = pooled_mean(squares, evaluation.weights)
    nonzero = means > 0  # a state without any error has no influence
    root = np.sqrt(means[nonzero]) * scale[nonzero]
    score = (np.sqrt(means) / scale).sum()
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = ((squares[:, nonzero] - means[nonzero]) / (2.0 * root * score)).sum(axis=1)
        logarithm = float(np.log(score))
    return (
        logarithm,
        parts if evaluation.weights is None else parts * evaluation.weights / evaluation.weights.mean(),
    )


class Loss(NamedTuple):
    """A tuned filter that is significantly worse than a baseline."""

    case: Case
    baseline: str
    paired: Paired


class Verdict(NamedTuple):
    """What all comparisons of a panel but those with the oracle say together."""

    comparisons: int  # of filters that are not the same
    losses: tuple[Loss, ...]  # significant over all comparisons together, by Holm's procedure
    above: int  # comparisons whose 95 % interval lies above 1
    wins: int  # comparisons whose 95 % interval lies below 1

    @property
    def by_chance(self) -> float:
        """Intervals that chance would put above 1 if no tuned filter were better or worse than a baseline."""
        return TAIL * self.comparisons


def verdict_of(cases: Sequence[Case]) -> Verdict:
    """Which tuned filters are significantly worse than a baseline; the oracle's is no baseline that one has."""
    pairs = [
        Loss(case, name, paired) for case in cases for name, paired in case.baselines.items() if name != ORACLE
    ]
    other = [pair for pair in pairs if not pair.paired.ratio.low == pair.paired.ratio.high == 1.0]
    worse = holm([pair.paired.chance for pair in other])
    losses = tuple(pair for pair, is_worse in zip(other, worse, strict=True) if is_worse)
    above = sum(pair.paired.ratio.low > 1.0 for pair in other)
    return Verdict(len(other), losses, above, sum(pair.paired.ratio.high < 1.0 for pair in other))


def baselines_of(cases: Sequence[Case]) -> list[str]:
    """The names of all baselines of some cases, in the order of columns."""
    names = dict.fromkeys(name for case in cases for name in case.baselines)
    return sorted(names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST) + (name == ORACLE))


def header(cases: Sequence[Case]) -> list[str]:
    """The heads of columns."""
    return ["problem", "filter", *(f"over {name}" for name in baselines_of(cases)), "NIS", "chosen"]


def rows_of(cases: Sequence[Case]) -> list[list[str]]:
    """A row a case: ratios to each baseline with 95 % intervals, mean NIS, and what the study chose."""
    lost = {(loss.case.problem, loss.case.filter, loss.baseline) for loss in verdict_of(cases).losses}
    names, rows, before = baselines_of(cases), [], ""
    for case in cases:
        cells = [
            _ratio(case.baselines.get(name), (case.problem, case.filter, name) in lost) if not case.error else ""
            for name in names
        ]
        ended = _ended(case)
        nis = "" if math.isnan(case.nis) else f"{case.nis:.2f}"
        rows.append([case.problem if case.problem != before else "", case.filter, *cells, nis, ended])
        before = case.problem
    return rows


def sentences(cases: Sequence[Case]) -> list[str]:
    """What the table says, in words."""
    verdict, failed = verdict_of(cases), [case for case in cases if case.error]
    lines = [
        f"The tuned filter is significantly worse than a baseline in {len(verdict.losses)} of "
        f"{verdict.comparisons} comparisons (Holm's procedure, {100 * LEVEL:g} % for all together, without the "
        f"oracle), and better in {verdict.wins}, by the 95 % interval of each.",
        f"95 % intervals that lie above 1: {verdict.above}; with equally good filters and baselines one would "
        f"expect {verdict.by_chance:.1f} by chance.",
    ]
    for loss in verdict.losses:
        ratio = loss.paired.ratio
        small = slightly(ratio)
        lines.append(
            f"{loss.case.problem}, {loss.case.filter}: {ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}] "
            f"times the score of {_article(loss.baseline)}"
            + (f", {small}, which is practically none." if small else ".")
        )
    return lines + [f"{case.problem}, {case.filter} failed: {case.error}" for case in failed]


def _ended(case: Case) -> str:
    """What the study wrote: its best trial, or the baseline to which that gave way."""
    return "failed" if case.error else case.gave_way or "a trial"


def _article(baseline: str) -> str:
    return "what was given" if baseline == "given" else f"the {baseline}"


def _ratio(paired: Paired | None, is_worse: bool) -> str:
    if paired is None:
        return "none"
    value, low, high = paired.ratio
    if low == high == 1.0:
        return "1, the same"
    return f"{value:.3f} [{low:.3f}, {high:.3f}]" + f" {MARK}" * is_worse


@cache
def cases() -> tuple[Case, ...]:
    """All cases of the panel."""
    return tuple(run_panel(Panel(), RESULTS))


def users() -> str:
    """Scores of two filters over those of three baselines, in parentheses if the interval covers 1."""

    def brief(cell: str) -> str:
        match = re.match(r"([\d.]+) \[([\d.]+), ([\d.]+)\]", cell)
        if match is None:
            return cell.removesuffix(", the same")
        covers = float(match[2]) <= 1.0 <= float(match[3])
        return (f"({match[1]})" if covers else match[1]) + cell[match.end() :]

    panel = cases()
    heads = header(panel)
    columns = [at for at, head in enumerate(heads) if head not in NOT_ON_PAGE]
    rows = [row for row in rows_of(panel) if row[1] not in NOT_ON_PAGE]
    cells = [[brief(row[at]) for at in columns] for row in rows]
    names = [[f"`{row[0]}`" if row[0] else "", f"`{row[1]}`", *row[2:]] for row in cells]
    return markdown_table([heads[at] for at in columns], names)


def losses() -> str:
    """How often tuning lost, and where."""
    return "\n".join(f"- {sentence}" for sentence in sentences(cases()))


def reproduce(
    problem: Annotated[Sequence[str], Option(INPUT, metavar="MODULE:OBJECT")] = (),
    filters: Annotated[Sequence[str], Option(RUNS, ("--filter",))] = (),
    trials: Annotated[int | None, Option(RUNS, least=1, most=1_000_000)] = None,
    seed: Annotated[int, Option(RUNS, least=0, most=2**31 - 1)] = 0,
    quick: Annotated[bool, Option(RUNS)] = False,
    out: Annotated[Path, Option(OUTPUT)] = RESULTS,
) -> Printed:
    """Tune filters on users' problems, and compare each with its user's baselines.

    The table has the held-out score of the tuned filter over that of each baseline, with 95 % intervals paired by
    run; "!" marks significantly worse ones, by Holm's procedure at 5 % over the whole table. Ctrl-C keeps
    finished cases, and the same command continues. All cases take about an hour on one core.

    Example: thruster reproduce users --quick

    Args:
        problem: a problem, may be repeated; by default the twelve of tests/users in a checkout of the project.
        filters: a filter, may be repeated; by default ekf, ukf, enkf, ekf-robust.
        trials: trials of each study; 50.
        seed: seed of all studies.
        quick: two problems, one filter, four trials: a test run without meaningful results.
        out: folder of results; existing ones are not recomputed. Use another one after changes in the code.
    """
    arguments: dict[str, Any] = {"problems": problem, "filters": filters, "trials": trials, "seed": seed}
    changes: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in arguments.items() if value
    }
    panel = (QUICK if quick else Panel())._replace(**changes)
    with progress_of("tuning", out) as progress:
        cases = run_panel(panel, out, progress)
    conclusions = sentences(cases)
    heads, rows = header(cases), rows_of(cases)

    def plain(case: Case) -> dict[str, Any]:
        pairs = case.baselines.items()
        baselines = {name: {**paired.ratio._asdict(), "chance": paired.chance} for name, paired in pairs}
        return {**case._asdict(), "baselines": baselines}

    data = {"cases": [plain(case) for case in cases], "answers": conclusions}
    title = f"scores of tuned filters over those of baselines, held out; {panel.trials} trials"
    return Printed([Table(title, heads, rows), *conclusions], data)


TABLES = {"users": users, "users_losses": losses}
