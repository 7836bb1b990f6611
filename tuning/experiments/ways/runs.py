"""All results of a protocol: what is done is kept in files, and never repeated."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from thruster_env.core.files import write_whole
from tuning.experiments.users.significance import holm
from tuning.experiments.ways.entries import Result, Scored, reference, run_way
from tuning.experiments.ways.problems import REFERENCE, Case, Protocol

OnResult = Callable[[str, int, int], None]  # what is done, results so far, all


def jobs_of(protocol: Protocol) -> Iterator[tuple[Case, str, int]]:
    """All that there is to do, one data set after the other, so that an early end leaves whole ones."""
    models = {case.model: case for case in reversed(protocol.cases)}
    yield from ((case, REFERENCE, 0) for case in protocol.cases if models[case.model] is case)
    for place in range(protocol.sets):
        yield from ((case, way, place) for case in protocol.cases for way in protocol.ways)


def run_protocol(
    protocol: Protocol, folder: Path, jobs: int = 1, on_result: OnResult = lambda text, done, count: None
) -> list[Result]:
    """Do what no file in the folder is there of, and return all results.

    Several hosts may share the folder: nothing in it is done again, and each file is written whole.

    Args:
        protocol: how much is done.
        folder: for a file a result.
        jobs: processes.
        on_result: called after each result.

    Raises:
        KeyboardInterrupt: on Ctrl-C; finished results are kept.
    """
    wanted = list(jobs_of(protocol))
    missing = [one for one in wanted if not file_of(folder, *one, protocol).is_file()]
    done = len(wanted) - len(missing)
    on_result("", done, len(wanted))
    if jobs == 1:
        for one in missing:
            done += 1
            if not file_of(folder, *one, protocol).is_file():
                _one(*one, protocol, folder)
            on_result(f"{one[0].name}, {one[1]}", done, len(wanted))
    elif missing:
        with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
            waiting = {pool.submit(_one, *one, protocol, folder): one for one in missing}
            try:
                for future in as_completed(waiting):
                    future.result()
                    done += 1
                    case, way, _ = waiting[future]
                    on_result(f"{case.name}, {way}", done, len(wanted))
            except KeyboardInterrupt:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return read(folder, protocol)


def read(folder: Path, protocol: Protocol) -> list[Result]:
    """The results that are there."""
    files = (file_of(folder, *one, protocol) for one in jobs_of(protocol))
    return [_result(json.loads(file.read_text(encoding="utf-8"))) for file in files if file.is_file()]


def file_of(folder: Path, case: Case, way: str, place: int, protocol: Protocol) -> Path:
    """The file of a result, whose name says what it depends on."""

    def plain(text: str) -> str:
        return "".join(one if one.isalnum() else "-" for one in text)

    if way == REFERENCE:
        return folder / plain(case.model) / f"{way}-{protocol.many}-{protocol.starts}-{protocol.held_out}.json"
    budget = f"{protocol.runs:g}-{protocol.seconds:g}-{protocol.held_out}"
    return folder / plain(case.name) / f"{plain(way)}-{place}-{budget}.json"


def _one(case: Case, way: str, place: int, protocol: Protocol, folder: Path) -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    file = file_of(folder, case, way, place, protocol)
    if file.is_file():  # of another host, meanwhile
        return
    result = reference(case, protocol) if way == REFERENCE else run_way(case, way, place, protocol)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, json.dumps(_as_data(result), indent=1))


def _as_data(result: Result) -> dict[str, Any]:
    content = result._asdict()
    for name in ("by_runs", "by_seconds"):
        content[name] = {key: list(one) for key, one in content[name].items()}
    return content


def _result(content: dict[str, Any]) -> Result:
    for name in ("by_runs", "by_seconds"):
        content[name] = {key: Scored(*map(_float, one)) for key, one in content[name].items()}
    last: Sequence[float] | None = content.pop("last")
    return Result(**content, last=None if last is None else Scored(*map(_float, last)))


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


# Regrets of ways with intervals over data sets, and which ways are significantly worse than the best.


LEVEL = 0.05
EQUAL = 0.01  # of log ratios: "equal" is within 1 %


def within(kind: str, key: str) -> Callable[[Result], Scored | None]:
    """What of a result counts: what the way gave for a budget of "by_runs" or "by_seconds"."""
    return lambda one: getattr(one, kind).get(key)


class Regret(NamedTuple):
    """A way on the data sets of a case."""

    way: str
    ratio: (
        Interval  # score over that of the best constant numbers: mean of logarithms with Student's 95 % interval
    )
    median: float
    worst: float
    nees: float  # median over data sets, over the number of states
    nis: float
    log_score: float  # mean loss a step against the best constant numbers of least error [nat]
    failures: int
    sets: int
    runs: float  # median of what it took
    seconds: float
    worse: bool = False  # significantly worse than the best way of the case, by Holm's procedure at 5 %

    @property
    def equal(self) -> bool:
        """Whether it is equal to the best constant numbers: within 1 % for sure."""
        return self.ratio.low > math.exp(-EQUAL) and self.ratio.high < math.exp(EQUAL)


def regrets(
    results: Sequence[Result], case: Case, at: Callable[[Result], Scored | None] = lambda one: one.last
) -> list[Regret]:
    """The ways that a case allows, the best first; those with fewer data sets than the others, too.

    Args:
        results: of a protocol.
        case: of it.
        at: what of a result counts, by default what the way gave in the end.
    """
    reference = reference_of(results, case)
    if reference is None:
        return []
    logs: dict[str, dict[int, float]] = {}
    found, by_way = [], _by_way(results, case)
    for way, some in by_way.items():
        scores = {one.set: at(one) for one in some}
        logs[way] = {
            place: math.log(one.score / reference.score) for place, one in scores.items() if one is not None
        }
        values = np.array(list(logs[way].values()))
        if not len(values):
            continue
        there = [one for one in scores.values() if one is not None]
        found.append(
            Regret(
                way,
                _exp(student(values)),
                math.exp(float(np.median(values))),
                math.exp(float(values.max())),
                float(np.median([one.nees for one in there])),
                float(np.median([one.nis for one in there])),
                reference.log_score - float(np.mean([one.log_score for one in there])),
                sum(bool(one.error) for one in some),
                len(values),
                float(np.median([one.taken_runs for one in some])),
                float(np.median([one.taken_seconds for one in some])),
            )
        )
    found.sort(key=lambda one: one.ratio.value)
    worse = holm([chance(logs[one.way], logs[found[0].way]) for one in found], LEVEL)
    return [one._replace(worse=is_worse) for one, is_worse in zip(found, worse, strict=True)]


def reference_of(results: Sequence[Result], case: Case) -> Scored | None:
    """What the best constant numbers of a case have, which cases that differ in their data share."""
    names = {one.case for one in results if one.way == REFERENCE}
    name = next((one for one in (case.name, case.name.split(",")[0]) if one in names), None)
    return next((one.last for one in results if one.way == REFERENCE and one.case == name), None)


def _by_way(results: Iterable[Result], case: Case) -> dict[str, list[Result]]:
    found: dict[str, list[Result]] = {}
    for one in results:
        if one.case == case.name and one.way != REFERENCE and one.last is not None:
            found.setdefault(one.way, []).append(one)
    return found


def student(values: np.ndarray) -> Interval:
    """The mean of some values with Student's 95 % interval; without ends for a single one."""
    from scipy.special import stdtrit

    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, -math.inf, math.inf)
    half = float(stdtrit(len(values) - 1, 1.0 - LEVEL / 2.0)) * float(values.std(ddof=1)) / math.sqrt(len(values))
    return Interval(mean, mean - half, mean + half)


def chance(one: dict[int, float], best: dict[int, float]) -> float:
    """One-sided p-value of "no worse than the best", by Student's test of differences paired by data set."""
    from scipy.special import stdtr

    shared = [place for place in one if place in best]
    differences = np.array([one[place] - best[place] for place in shared])
    if len(differences) < 2 or not differences.any():
        return 1.0
    error = differences.std(ddof=1) / math.sqrt(len(differences))
    if error == 0.0:
        return 0.0 if differences[0] > 0 else 1.0
    return float(stdtr(len(differences) - 1, -differences.mean() / error))


def _exp(one: Interval) -> Interval:
    return Interval(*(math.exp(min(end, 700.0)) for end in one))
