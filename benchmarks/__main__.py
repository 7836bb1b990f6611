"""`python -m benchmarks`: speed beside other packages, in one table."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.timing import COLUMNS, Row, check_page, machine, machine_lines, write_page
from thruster_env.core.checks import one_of
from thruster_env.core.text_tables import Table
from tuning.api.markers import OUTPUT, RUNS, WRITTEN, Option, Seed
from tuning.api.result import Printed
from tuning.cli.output import progress_console
from tuning.cli.verbs import command_of
from tuning.policies.algorithms import check_installed

CAPTION = (
    "A step's time counts env, filter and fresh info arrays; FilterPy's, one predict and update and no env. "
    "Ensembles in evaluate and in batches: time a member and step, 500 steps, on all cores; batches are of 256 "
    "trajectories. On copies of a vector env: time a copy and step, env and filter. Times are the best of many "
    "rounds, ratios the median over rounds that measure both in turn. "
    "Goals are the most that a ratio or a time may be."
)

PARTS = {  # with the modules and functions that measure their rows
    **{"steps": "steps.rows", "vectors": "steps.vector_rows", "vector_filters": "steps.vector_filter_rows"},
    **{"batches": "batches.rows", "c_code": "c_code.rows", "horizon": "steps.horizon_rows"},
    **{"vehicles": "steps.vehicle_rows", "trajectories": "batches.trajectory_rows", "studies": "studies.rows"},
    **{
        "attitude": "batches.attitude_rows",
        "assimilation": "studies.assimilation_rows",
        "policies": "studies.policy_rows",
    },
    **{"processes": "first_use.rows", "peers": "peers.rows"},
}


def rows_of(part: str) -> Callable[[int, bool], Iterator[Row]]:
    """The function that measures a part, its packages imported."""
    module, _, function = PARTS[part].partition(".")
    return getattr(importlib.import_module(f"benchmarks.{module}"), function)


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def command(
    quick: Annotated[bool, Option(RUNS)] = False,
    part: Annotated[Sequence[str], Option(RUNS, choices=PARTS)] = (),
    page: Annotated[Path | None, Option(OUTPUT, metavar="FILE", file=WRITTEN)] = None,
    seed: Seed = 0,
) -> Printed:
    """Measure the speed of env, filters and evaluation beside Gymnasium's, FilterPy's and JAX's, in some minutes.

    All is measured in this run, ours and the peer in turns, on an otherwise idle machine if the times are to
    mean much. A goal that is missed prints "no" and fails nothing: times are the machine's as well.

    Args:
        quick: few rounds: shows that all runs; the times are rough.
        part: measure these parts only:
        page: write the table into a page anew: docs/speed.md.
        seed: seed of all randomness; the same seed gives the same results.
    """
    if importlib.util.find_spec("filterpy") is None:
        raise ValueError(
            "FilterPy must be installed to compare with: `make bench` does it, or pip install -e '.[peers]'"
        )
    check_installed()
    parts = [one_of("part", name, tuple(PARTS)) for name in part or PARTS]
    if page is not None:
        if part:
            raise ValueError(f"--part must go without --page, which has all parts, but got --page {page}")
        if quick:
            raise ValueError(f"--quick must go without --page, for its times are rough, but got --page {page}")
        check_page(page)
    # After the checks: they import FilterPy, or Stable-Baselines3.
    measures = {name: rows_of(name) for name in parts}
    from benchmarks import steps, studies

    rows, failed, resident = [], [], None
    with progress_console.status("measuring ...") as status:
        for name, rows_of_part in measures.items():
            try:
                for row in rows_of_part(seed, quick):
                    rows.append(row)
                    status.update(f"measured: {row.what} ...")
            except Exception as error:  # the rows of other parts took minutes
                failed.append(f"{name}: {error!r}")
        if "studies" in parts:
            status.update("memory of the study ...")
            resident = studies.resident_memory(seed, quick)
    facts = machine()
    speeds = Table("Speed, side by side", COLUMNS, [row.cells() for row in rows], caption=CAPTION)
    memory = [steps.memory_line(), *([studies.memory_line(resident)] if "studies" in parts else [])]
    if page is not None and not failed:
        write_page(page, rows, facts, memory)
    data = {
        "rows": [row.as_json() for row in rows],
        "failed": failed,
        "study_resident_megabytes": resident,
        "machine": facts,
        "seed": seed,
        "quick": quick,
    }
    errors = [f"failed: {error}" for error in failed]
    return Printed([speeds, *memory, *machine_lines(facts), *errors], data, exit_code=bool(failed))


app.command()(command_of(command))


def main() -> None:
    """Run the command; a user's mistake is one line and exit code 2, never a traceback."""
    try:
        app(prog_name="python -m benchmarks")
    except ValueError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("benchmarks: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
