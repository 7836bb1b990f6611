"""Timing two programs in turns, so that both meet the same load of the machine, and tables of the times."""

from __future__ import annotations

import gc
import os
import platform
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import NamedTuple

from thruster_env.core.checks import short_repr
from thruster_env.core.files import write_whole
from thruster_env.core.text_tables import markdown_table, with_tables

Measure = Callable[[], float]
"""Does one round of work and returns the seconds that a unit of it (a step, say) took."""
COLUMNS = ["what; peer", "ours", "peer", "ratio", "goal", "met?"]
PACKAGES = ("numba", "gymnasium", "numpy", "filterpy", "jax", "casadi", "do_mpc", "stable_baselines3", "torch")
HEADER = ("what", "beside", "ours", "theirs", "ratio", "goal", "met")
NO_BREAK = "\N{NO-BREAK SPACE}"  # between a number and its unit
MARK, END = "<!-- table speed: ", "<!-- end -->"


class Timing(NamedTuple):
    """Seconds a unit of work, ours and the peer's."""

    ours: float  # [s], best of all rounds
    peer: float | None  # [s], best of all rounds
    ratio: float | None  # ours over the peer's: median over the rounds, which slow spells cannot bend


@contextmanager
def _no_collection():
    """Suspend the garbage collector, which would charge one program for the garbage of the other."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def side_by_side(ours: Measure, peer: Measure, rounds: int, *, warm_up: bool = True) -> Timing:
    """Measure both once a round, in an order that alternates, after a first round that does not count."""
    if warm_up:
        ours(), peer()
    pairs = []
    with _no_collection():
        for number in range(rounds):
            if number % 2:
                second = peer()
                pairs.append((ours(), second))
            else:
                pairs.append((ours(), peer()))
    return Timing(*(min(times) for times in zip(*pairs, strict=True)), median(a / b for a, b in pairs))


def alone(ours: Measure, rounds: int, *, warm_up: bool = True) -> Timing:
    """Measure something that has no peer, after a first round that does not count."""
    if warm_up:
        ours()
    with _no_collection():
        return Timing(min(ours() for _ in range(rounds)), None, None)


def seconds_a_call(function: Callable, arguments: Iterable[tuple], prepare: Callable = lambda: None) -> Measure:
    """A measure that prepares, untimed, then calls function(*a) for every a of `arguments`."""
    arguments = list(arguments)

    def measure() -> float:
        prepare()
        begin = perf_counter()
        for a in arguments:
            function(*a)
        return (perf_counter() - begin) / len(arguments)

    return measure


class Row(NamedTuple):
    """A timing and the most that its ratio to the peer, or its time, may be."""

    what: str
    peer_name: str | None
    timing: Timing
    ratio_goal: float | None = None
    time_goal: float | None = None  # [s]

    @property
    def met(self) -> bool | None:
        """Whether the goal is met; None without a goal."""
        for value, goal in ((self.timing.ratio, self.ratio_goal), (self.timing.ours, self.time_goal)):
            if goal is not None:
                return value <= goal
        return None

    @property
    def goal(self) -> str:
        """The goal as text."""
        if self.ratio_goal is not None:
            return f"{self.ratio_goal:.2g}"
        return "-" if self.time_goal is None else readable(self.time_goal)

    def cells(self) -> list[str]:
        """The row as text, by `COLUMNS`."""
        return [
            self.what if self.peer_name is None else f"{self.what}; {self.peer_name}",
            readable(self.timing.ours),
            "-" if self.timing.peer is None else readable(self.timing.peer),
            "-" if self.timing.ratio is None else rounded(self.timing.ratio),
            self.goal,
            {True: "yes", False: "no", None: "-"}[self.met],
        ]

    def as_json(self) -> dict:
        """The row with all times in seconds."""
        return {
            "what": self.what,
            "peer": self.peer_name,
            "ours_seconds": self.timing.ours,
            "peer_seconds": self.timing.peer,
            "ratio": self.timing.ratio,
            "ratio_goal": self.ratio_goal,
            "time_goal_seconds": self.time_goal,
            "met": self.met,
        }


def rounded(number: float, figures: int = 3) -> str:
    """A number with so many figures, or all those before the point."""
    return f"{number:.0f}" if number >= 10**figures - 0.5 else f"{number:.{figures}g}"


def readable(seconds: float) -> str:
    """A time with three figures in the unit that suits it."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{rounded(seconds / size)} {unit}"
    return f"{rounded(seconds / 1e-9)} ns"


def machine() -> dict[str, str | int | bool]:
    """Processor, cores and versions, on which the times depend beside the code."""
    from llvmlite import binding  # comes with numba

    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "system": f"{platform.system()} {platform.machine()}",
        "architecture": binding.get_host_cpu_name(),
        "avx512": binding.get_host_cpu_features().get("avx512f", False),
        "python": platform.python_version(),
        **{package: version(package) for package in PACKAGES if find_spec(package)},
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # no Linux
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "unknown processor"


def machine_name(facts: dict) -> str:
    """Processor and cores, which identify a machine."""
    return f"{facts['cpu']}, {facts['cores']} cores"


def machine_lines(facts: dict) -> list[str]:
    """The machine in two lines of text."""
    packages = ", ".join(f"{name} {facts[name]}" for name in PACKAGES if name in facts)
    avx512 = " with AVX-512" if facts["avx512"] else ""
    return [
        f"Machine: {machine_name(facts)}, {facts['system']}; {facts['architecture']}{avx512}.",
        f"Python {facts['python']}, {packages}.",
    ]


def check_page(path: Path) -> None:
    """Raise ValueError unless a page has a place for the table, before minutes of measuring."""
    try:
        page = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise ValueError(f"--page must be a page that can be read, but got {short_repr(str(path))}") from None
    if MARK not in page:
        raise ValueError(f"--page must be a page with {MARK}PROCESSOR, N cores -->, but {path} has none")


def write_page(path: Path, rows: Sequence[Row], facts: dict, memory: Sequence[str]) -> None:
    """Replace this machine's section or append it; those of other machines stay."""
    page, name = path.read_text(encoding="utf-8"), f"speed: {machine_name(facts)}"
    mark = f"<!-- table {name} -->"
    if mark not in page:
        last = [match.end() for match in re.finditer(f"{MARK}.*?{END}", page, flags=re.DOTALL)][-1]
        page = f"{page[:last]}\n\n{mark}\n{END}{page[last:]}"
    write_whole(path, with_tables(page, {name: lambda: machine_section(rows, facts, memory)}))


def machine_section(rows: Sequence[Row], facts: dict, memory: Sequence[str]) -> str:
    """The machine's name as a heading, its table and its other facts."""
    lines = " ".join([*machine_lines(facts), *memory])
    return f"\n## On {machine_name(facts)}\n\n{speed_table(rows)}\n\n{lines}\n"


def speed_table(rows: Sequence[Row]) -> str:
    """All rows as a table in Markdown, with empty cells for missing values."""
    lines = []
    for row in rows:
        _, *cells = row.cells()
        numbers = ("" if cell == "-" else cell.replace(" ", NO_BREAK) for cell in cells)
        lines.append([row.what, row.peer_name or "", *numbers])
    return markdown_table(HEADER, lines)
