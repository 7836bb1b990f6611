"""Make the tables of docs/real_data.md, and the numbers that the project takes, from recordings of others.

    python -m pages.real_data_tables RECORDINGS [--results FILE.json] [FOLDER]

RECORDINGS is the folder that `thruster study recordings --data` takes. What FILE.json, out/recordings.json by
default, holds of identifications is not done again; without it they take a quarter of an hour on two cores.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pages.page import DOCS
from thruster_env.core.files import as_toml, write_whole
from thruster_env.core.text_tables import markdown_table, with_tables
from tuning.experiments.recordings.identification import CHOSEN, Task, identify_all
from tuning.experiments.recordings.measure import estimates_of, regimes
from tuning.experiments.recordings.model import IDENTIFIED, model
from tuning.experiments.recordings.runs import read_recordings
from tuning.experiments.recordings.tables import sentences
from tuning.experiments.recordings.tables import tables_of as rows_of


def tables_of(recordings: Path, results: Path) -> dict[str, Callable[[], str]]:
    """What makes each table, by name."""
    runs = read_recordings(recordings)
    tasks = identify_all(runs, results, progress=lambda name, done, count: print(f"{done + 1}/{count} {name}"))
    keep(tasks[Task(CHOSEN).name], [run.name for run in runs])
    left_out, on_all = estimates_of(runs, tasks), estimates_of(runs)

    def regime() -> str:
        rows = [
            [f"{row.factor:g}", f"{row.log_likelihood:.0f}", f"{row.nis:.2f}", f"{row.ratio:.3f}"]
            for row in regimes(model(), runs)
        ]
        return markdown_table(["Q times", "log-likelihood of the tachometer", "mean NIS", "ratio, mean"], rows)

    tables = {
        name: (lambda table=table: markdown_table(*table))
        for name, table in rows_of(runs, left_out, tasks).items()
    }
    ratios = tables["ratios"]
    return {
        **tables,
        "ratios": lambda: "\n\n".join([ratios(), *sentences(left_out, runs)]),
        "all_runs": lambda: markdown_table(*rows_of(runs, on_all)["ratios"]),
        "regime": regime,
    }


def keep(task: Mapping, runs: Sequence[str]) -> None:
    """Write the numbers that the project takes."""
    known = {name: task[name] for name in ("log_likelihood", "standard_errors", "determined")}
    tables = {"values": task["values"], "identified": {"logs": list(runs), **known}}
    write_whole(IDENTIFIED, as_toml(tables, "Found by `python -m pages.real_data_tables`; see docs/real_data.md."))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page's tables anew."""
    parser = argparse.ArgumentParser(prog="python -m pages.real_data_tables", description=__doc__.split("\n")[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--results", type=Path, default=Path("out") / "recordings.json")
    parser.add_argument("folder", nargs="?", type=Path, default=DOCS)
    options = parser.parse_intermixed_args(arguments)
    page = options.folder / "real_data.md"
    write_whole(
        page, with_tables(page.read_text(encoding="utf-8"), tables_of(options.recordings, options.results))
    )


if __name__ == "__main__":
    main()
