"""The section of docs/speed.md on GPUs, from the rows of `benchmarks.gpu`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.timing import rounded
from thruster_env.core.text_tables import markdown_table

NAMES = {"kf": "KF, 4 states", "ekf": "EKF", "ukf": "UKF", "enkf": "EnKF"}
OURS = ("machine code", "eager", "compiled")


def page_section(content: dict[str, Any]) -> str:
    """The tables of one card in Markdown: forward, with gradients, and of one ensemble."""
    facts, rows = content["machine"], content["rows"]
    versions = ", ".join(f"{name} {facts[name]}" for name in facts if name not in ("card", "cores", "python"))
    batches = [row for row in rows if row["batch"] > 1]
    forward, with_gradient = ([row for row in batches if row["gradient"] is wanted] for wanted in (False, True))
    parts = [
        f"Card: {facts['card']}; processor with {facts['cores']} cores. Python {facts['python']}, {versions}.",
        f"Forward, million steps of a trajectory per second:\n\n{speeds(forward)}",
        f"With the gradient along Q and R, million steps of a trajectory per second:\n\n{speeds(with_gradient)}",
        "One EnKF of N members, million steps of a member per second:\n\n"
        + speeds([r for r in rows if r["batch"] == 1]),
        skipped_lines(rows),
        deviation_line(rows),
    ]
    return "\n\n".join(part for part in parts if part)


def speeds(rows: Sequence[dict[str, Any]]) -> str:
    """Millions of steps per second, float64 / float32, a column for each program."""
    programs = list(dict.fromkeys(row["program"] for row in rows))
    programs = [*(name for name in OURS if name in programs), *(name for name in programs if name not in OURS)]
    if not rows:
        return ""
    cells = {(_key(row), row["program"], row["single"]): _cell(row) for row in rows}
    lines = []
    for key in sorted({_key(row) for row in rows}, key=lambda key: (list(NAMES).index(key[0]), *key[1:])):
        values = []
        for program in programs:
            pair = [cells.get((key, program, single)) for single in (False, True)]
            values.append(" / ".join(cell for cell in pair if cell is not None))
        kind, batch, members = key
        what = f"N = {members:,}" if batch == 1 else f"{NAMES[kind]}{f', N = {members}' if members else ''}"
        lines.append([what, "1" if batch == 1 else f"{batch:,}", *values])
    return markdown_table(("filter", "batch", *programs), lines)


def _key(row: dict[str, Any]) -> tuple[str, int, int]:
    return row["kind"], row["batch"], row["members"]


def _cell(row: dict[str, Any]) -> str:
    if "skipped" in row:
        return "-"
    trajectories = row["steps_per_second"] / (max(row["members"], 1) if row["batch"] > 1 else 1)
    return f"{'≥ ' if row.get('lower_bound') else ''}{rounded(trajectories / 1e6)}"


def skipped_lines(rows: Sequence[dict[str, Any]]) -> str:
    """Why cells have no number."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if "skipped" in row:
            what = f"{row['kind']} {row['program']} of {row['batch']:,}"
            reasons.setdefault(row["skipped"], []).append(what)
    return "\n".join(f"- {reason}: {', '.join(dict.fromkeys(what))}" for reason, what in reasons.items())


def deviation_line(rows: Sequence[dict[str, Any]]) -> str:
    """The largest deviation from the log-likelihoods of `filters.run`, relative to the largest of them."""
    parts = []
    for name, single, ensemble in (
        ("float64", False, False),
        ("float32", True, False),
        ("ensembles, from the UKF's", None, True),
    ):
        deviations = [
            row["deviation"]
            for row in rows
            if "deviation" in row and (row["kind"] == "enkf") is ensemble and single in (None, row["single"])
        ]
        if deviations:
            parts.append(f"{name} {max(deviations):.1g}")
    return f"Largest deviation of a log-likelihood from `filters.run`: {', '.join(parts)}." if parts else ""
