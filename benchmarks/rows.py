"""What the benchmark prints: rows of measured times with their goals, and the machine they were taken on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from benchmarks.timing import Timing

COLUMNS = ["what; peer", "ours", "peer", "ratio", "goal", "met?"]
PACKAGES = ("numba", "gymnasium", "numpy", "filterpy", "jax", "stable_baselines3", "torch")


class Row(NamedTuple):
    """A timing, and the most that its ratio or its time may be."""

    what: str
    peer_name: str | None
    timing: Timing
    ratio_goal: float | None = None
    time_goal: float | None = None  # [s]

    @property
    def met(self) -> bool | None:
        """Whether the goal is met; None without a goal."""
        if self.ratio_goal is not None:
            return self.timing.ratio <= self.ratio_goal
        return None if self.time_goal is None else self.timing.ours <= self.time_goal

    def cells(self) -> list[str]:
        """The row as text, by `COLUMNS`."""
        if self.ratio_goal is not None:
            goal = f"{self.ratio_goal:.2g}"
        else:
            goal = "-" if self.time_goal is None else readable(self.time_goal)
        return [
            self.what if self.peer_name is None else f"{self.what}; {self.peer_name}",
            readable(self.timing.ours),
            "-" if self.timing.peer is None else readable(self.timing.peer),
            "-" if self.timing.ratio is None else f"{self.timing.ratio:.3g}",
            goal,
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


def readable(seconds: float) -> str:
    """A time with three figures in the unit that suits it."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def machine() -> dict[str, str | int]:
    """What the times depend on beside the code."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{package: version(package) for package in PACKAGES if find_spec(package)},
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # no Linux
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "unknown processor"


def machine_lines(facts: dict) -> list[str]:
    """The machine in two lines of text."""
    packages = ", ".join(f"{name} {facts[name]}" for name in PACKAGES if name in facts)
    return [
        f"Machine: {facts['cpu']}, {facts['cores']} cores, {facts['system']}.",
        f"Python {facts['python']}, {packages}.",
    ]
