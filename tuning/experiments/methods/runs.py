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
from tuning.experiments.methods.entries import Result, Scored, reference, run_method
from tuning.experiments.methods.problems import REFERENCE, Case, Protocol
from tuning.experiments.users import holm
from tuning.methods.registry import ALONE, ONLY

OnResult = Callable[[str, int, int], None]  # what is done, results so far, all


def jobs_of(protocol: Protocol) -> Iterator[tuple[Case, str, int]]:
    """All that there is to do, one data set after the other, so that an early end leaves whole ones."""
    models = {case.model: case for case in reversed(protocol.cases)}
    yield from ((case, REFERENCE, 0) for case in protocol.cases if models[case.model] is case)
    for set_index in range(protocol.sets):
        yield from ((case, method, set_index) for case in protocol.cases for method in protocol.methods)


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
    missing = [job for job in wanted if not file_of(folder, *job, protocol).is_file()]
    done = len(wanted) - len(missing)
    on_result("", done, len(wanted))
    if jobs == 1:
        for job in missing:
            done += 1
            if not file_of(folder, *job, protocol).is_file():
                _one(*job, protocol, folder)
            on_result(f"{job[0].name}, {job[1]}", done, len(wanted))
    elif missing:
        with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
            waiting = {pool.submit(_one, *job, protocol, folder): job for job in missing}
            try:
                for future in as_completed(waiting):
                    future.result()
                    done += 1
                    case, method, _ = waiting[future]
                    on_result(f"{case.name}, {method}", done, len(wanted))
            except KeyboardInterrupt:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return read(folder, protocol)


def read(folder: Path, protocol: Protocol) -> list[Result]:
    """The results that are there."""
    files = (file_of(folder, *job, protocol) for job in jobs_of(protocol))
    return [_result(json.loads(file.read_text(encoding="utf-8"))) for file in files if file.is_file()]


def file_of(folder: Path, case: Case, method: str, set_index: int, protocol: Protocol) -> Path:
    """The file of a result, whose name says what it depends on."""

    def plain(text: str) -> str:
        return "".join(letter if letter.isalnum() else "-" for letter in text)

    if method == REFERENCE:
        return folder / plain(case.model) / f"{method}-{protocol.many}-{protocol.starts}-{protocol.held_out}.json"
    budget = f"{protocol.runs:g}-{protocol.seconds:g}-{protocol.held_out}"
    return folder / plain(case.name) / f"{plain(method.removesuffix(ONLY))}-{set_index}-{budget}.json"


def _one(case: Case, method: str, set_index: int, protocol: Protocol, folder: Path) -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    file = file_of(folder, case, method, set_index, protocol)
    if file.is_file():  # of another host, meanwhile
        return
    result = reference(case, protocol) if method == REFERENCE else run_method(case, method, set_index, protocol)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, json.dumps(_as_data(result), indent=1))


def _as_data(result: Result) -> dict[str, Any]:
    content = result._asdict()
    for name in ("by_runs", "by_seconds"):
        content[name] = {key: list(scored) for key, scored in content[name].items()}
    return content


def _result(content: dict[str, Any]) -> Result:
    """A result as `_as_data` has it; files of 2026 call the method `way`, and samplers have no "-only"."""
    name = content.pop("way", None) or content["method"]
    content["method"] = f"{name}{ONLY}" if f"{name}{ONLY}" in ALONE else name
    for name in ("by_runs", "by_seconds"):
        content[name] = {key: Scored(*map(_float, scored)) for key, scored in content[name].items()}
    last: Sequence[float] | None = content.pop("last")
    return Result(**content, last=None if last is None else Scored(*map(_float, last)))


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


# Regrets of methods with intervals over data sets, and which methods are significantly worse than the best.


LEVEL = 0.05
EQUAL = 0.01  # of log ratios: "equal" is within 1 %


def within(kind: str, key: str) -> Callable[[Result], Scored | None]:
    """What of a result counts: what the method gave for a budget of "by_runs" or "by_seconds"."""
    return lambda result: getattr(result, kind).get(key)


class Regret(NamedTuple):
    """A method on the data sets of a case."""

    method: str
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
    worse: bool = False  # significantly worse than the best method of the case, by Holm's procedure at 5 %

    @property
    def equal(self) -> bool:
        """Whether it is equal to the best constant numbers: within 1 % for sure."""
        return self.ratio.low > math.exp(-EQUAL) and self.ratio.high < math.exp(EQUAL)


def regrets(
    results: Sequence[Result], case: Case, at: Callable[[Result], Scored | None] = lambda result: result.last
) -> list[Regret]:
    """The methods that a case allows, the best first; those with fewer data sets than the others, too.

    Args:
        results: of a protocol.
        case: of it.
        at: what of a result counts, by default what the method gave in the end.
    """
    reference = reference_of(results, case)
    if reference is None:
        return []
    logs: dict[str, dict[int, float]] = {}
    regrets_, by_method = [], _by_method(results, case)
    for method, of_method in by_method.items():
        scores = {result.set: at(result) for result in of_method}
        logs[method] = {
            set_index: math.log(scored.score / reference.score)
            for set_index, scored in scores.items()
            if scored is not None
        }
        values = np.array(list(logs[method].values()))
        if not len(values):
            continue
        valid = [scored for scored in scores.values() if scored is not None]
        regrets_.append(
            Regret(
                method,
                _exp(student(values)),
                math.exp(float(np.median(values))),
                math.exp(float(values.max())),
                float(np.median([scored.nees for scored in valid])),
                float(np.median([scored.nis for scored in valid])),
                reference.log_score - float(np.mean([scored.log_score for scored in valid])),
                sum(bool(result.error) for result in of_method),
                len(values),
                float(np.median([result.taken_runs for result in of_method])),
                float(np.median([result.taken_seconds for result in of_method])),
            )
        )
    regrets_.sort(key=lambda regret: regret.ratio.value)
    worse = holm([chance(logs[regret.method], logs[regrets_[0].method]) for regret in regrets_], LEVEL)
    return [regret._replace(worse=is_worse) for regret, is_worse in zip(regrets_, worse, strict=True)]


def reference_of(results: Sequence[Result], case: Case) -> Scored | None:
    """What the best constant numbers of a case have, which cases that differ in their data share."""
    names = {result.case for result in results if result.method == REFERENCE}
    name = next((candidate for candidate in (case.name, case.name.split(",")[0]) if candidate in names), None)
    return next((result.last for result in results if result.method == REFERENCE and result.case == name), None)


def _by_method(results: Iterable[Result], case: Case) -> dict[str, list[Result]]:
    by_method: dict[str, list[Result]] = {}
    for result in results:
        if result.case == case.name and result.method != REFERENCE and result.last is not None:
            by_method.setdefault(result.method, []).append(result)
    return by_method


def student(values: np.ndarray) -> Interval:
    """The mean of some values with Student's 95 % interval; without ends for a single one."""
    from scipy.special import stdtrit

    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, -math.inf, math.inf)
    half = float(stdtrit(len(values) - 1, 1.0 - LEVEL / 2.0)) * float(values.std(ddof=1)) / math.sqrt(len(values))
    return Interval(mean, mean - half, mean + half)


def chance(logs: dict[int, float], best: dict[int, float]) -> float:
    """One-sided p-value of "no worse than the best", by Student's test of differences paired by data set."""
    from scipy.special import stdtr

    shared = [set_index for set_index in logs if set_index in best]
    differences = np.array([logs[set_index] - best[set_index] for set_index in shared])
    if len(differences) < 2 or not differences.any():
        return 1.0
    error = differences.std(ddof=1) / math.sqrt(len(differences))
    if error == 0.0:
        return 0.0 if differences[0] > 0 else 1.0
    return float(stdtr(len(differences) - 1, -differences.mean() / error))


def _exp(interval: Interval) -> Interval:
    return Interval(*(math.exp(min(end, 700.0)) for end in interval))
