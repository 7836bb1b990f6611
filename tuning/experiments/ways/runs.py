"""All results of a protocol: what is done is kept in files, and never repeated."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from thruster_env.core.files import write_whole
from tuning.experiments.ways.entries import Result, Scored, reference, run_way
from tuning.experiments.ways.problems import Case
from tuning.experiments.ways.protocol import REFERENCE, Protocol

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
