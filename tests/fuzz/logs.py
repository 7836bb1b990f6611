"""Logs of careless recorders: gaps, stuck sensors, doubled stamps, jitter, odd names and units.

Each is read, with no sample lost that is not counted and what was done to it found, or refused in one line.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from thruster_env.logs.findings import sentences
from thruster_env.logs.log import Log
from thruster_env.logs.read import read_log
from thruster_env.logs.write import draw_findings, write_columns, write_log
from thruster_env.model.affine import affine_model
from tuning.logs.problem import cut_at_gaps
from tuning.problems.log_problem import LogProblem

NAMES = ("voltage", "u", r"$\frac$", "[/]", "a,b", 'say "x"', "x;y", "é∞", "n" * 400, "thrust", "1", "t", "=1+1")
UNITS = ("", "V", "mV", "rpm", "Hz", "degC", "1/min", "furlong", "[", "min", "kgf", "%")
TIMES = {"t": 1.0, "time_ms": 1e3, "t [min]": 1 / 60, "timestamp": 1.0, "time (h)": 1 / 3600}
MODEL = affine_model(
    a=[[0.9]],
    b=[[0.5]],
    c=[[1.0]],
    process_noise_cov=[0.01],
    measurement_noise_cov=[0.04],
    prior_mean=[0.0],
    prior_cov=[1.0],
    input_quantities=[("force", "u_1", "N")],
    measurements=[("speed", "z_1", "rad/s")],
)


def careless_recorders(rng: np.random.Generator, seconds: float) -> str:
    """Tables with everything that goes wrong on a bench, in memory and in files."""
    counts, end = Counter(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        while not counts or time.monotonic() < end:
            table, done = _recorded(rng)
            try:
                log = read_log(
                    table, MODEL, dt=float(rng.choice([0.01, 0.02, 0.3])) if rng.random() < 0.2 else None
                )
            except ValueError as error:
                assert str(error) and "\n" not in str(error), repr(error)
                counts["refused"] += 1
                continue
            counts["read"] += 1
            _check_log(log, table)
            if not done["careless"]:
                _check_found(log, done)
            if rng.random() < 0.3:
                _check_files(rng, log, table, Path(folder))
            if rng.random() < 0.05:
                draw_findings(log).canvas.draw()
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def names_and_units(rng: np.random.Generator, seconds: float) -> str:
    """Headers and units of all kinds, told or found: a log, or one line."""
    counts, end = Counter(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        while not counts or time.monotonic() < end:
            path = Path(folder) / "run.csv"
            base = str(rng.choice(NAMES))
            unit = str(rng.choice(UNITS))
            header = (f"{base}_{unit}" if rng.random() < 0.5 else f"{base} [{unit}]") if unit else base
            path.unlink(missing_ok=True)  # no log is written over
            write_columns(path, {"time": 0.1 * np.arange(9), header: np.arange(9.0), "speed": rng.normal(size=9)})
            columns = {"u_1": header if rng.random() < 0.5 else base} if rng.random() < 0.8 else None
            try:
                log = read_log(path, MODEL, columns)
            except ValueError as error:
                assert str(error) and "\n" not in str(error) and len(str(error)) < 2000, repr(error)
                counts["refused"] += 1
                continue
            counts["read"] += 1
            assert np.isfinite(log.inputs).all() and log.steps == 8
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def blocks_of_logs(rng: np.random.Generator, seconds: float) -> str:
    """Runs short and long, with gaps and lost sensors, some twice: no gap in a block, nothing held out learnt."""
    counts, end = Counter(), time.monotonic() + seconds
    while not counts or time.monotonic() < end:
        logs: list[Log] = []
        for place in range(rng.integers(1, 6)):
            try:
                logs.append(read_log(_recorded(rng)[0], MODEL, dt=0.01, name=f"run{place}"))
            except ValueError:
                counts["refused logs"] += 1
        if logs and rng.random() < 0.2:
            logs.append(logs[0].named("copy"))
        held = [log.name for log in logs if rng.random() < 0.3] if rng.random() < 0.5 else None
        options = {"lead": int(rng.integers(60)) if rng.random() < 0.5 else None, "held_out": held}
        try:
            problem = LogProblem(logs, MODEL, **options, hold_gaps=bool(rng.integers(2)))
        except ValueError as error:
            assert str(error) and "\n" not in str(error), repr(error)
            counts["refused"] += 1
            continue
        counts["problems"] += 1
        _check_blocks(problem)
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def _recorded(rng: np.random.Generator) -> tuple[dict[str, np.ndarray], dict]:
    """A run, and what was done to it."""
    rows = int(rng.choice([3, 10, 60, 300, 800]))
    times = 0.01 * np.arange(rows) + rng.choice([0.0, 1e6])
    force = np.sign(np.sin(np.arange(rows) / rng.uniform(2.0, 30.0)))
    speed = np.cumsum(0.05 * force) + 0.2 * rng.normal(size=rows)
    done: dict = {"gap": 0, "stuck": 0, "careless": rng.random() < 0.5}
    if rows >= 300 and rng.random() < 0.5:
        first, done["stuck"] = int(rng.integers(10, 100)), 40
        speed[first : first + 40] = speed[first]
    kept = np.ones(rows, bool)
    if rows >= 300 and rng.random() < 0.5:
        first, done["gap"] = int(rng.integers(160, 240)), int(rng.integers(10, 40))
        kept[first : first + done["gap"]] = False
    if done["careless"]:
        kept &= rng.random(rows) > rng.choice([0.0, 0.01, 0.3])
        kept[0] = True
        times = np.sort(times + rng.uniform(0, 1, rows) * rng.choice([0.0, 1e-4, 5e-3, 0.02]))
        times[rows // 2 :] += rng.choice([0.0, 0.0034, 0.13, 60.0])
        for column in (force, speed):
            column[rng.random(rows) < rng.choice([0.0, 0.1, 0.9])] = np.nan
        force[np.flatnonzero(kept)[0]] = rng.choice([1.0, np.nan], p=[0.9, 0.1])
    time_name = str(rng.choice(list(TIMES)))
    table = {time_name: times * TIMES[time_name], "force": force, "speed": speed}
    table = {name: values[kept] for name, values in table.items()}
    if done["careless"] and rng.random() < 0.2:
        again = np.sort(rng.integers(len(table["force"]), size=3))
        table = {name: np.insert(values, again, values[again]) for name, values in table.items()}
    return table, done


def _check_log(log: Log, table: dict[str, np.ndarray]) -> None:
    """Each sample is on the grid or counted, and findings and pieces are of the log's rows."""
    there = int(np.isfinite(table["speed"]).sum())
    assert (
        int(np.isfinite(log.measurements).sum()) + dict(log.recording.dropped).get("measurement:z_1", 0) == there
    )
    assert np.isfinite(log.inputs).all()
    for one in log.findings:
        assert 0 <= one.first <= one.last <= log.steps and one.count > 0 and "\n" not in one.sentence
    assert all(said.endswith(".") for said in sentences(log.findings))
    rows = sum(count for _, count in log.pieces) + sum(count for _, count in log.recording.gaps)
    assert rows == log.steps + 1 and all(count > 0 for _, count in log.pieces)
    for piece in cut_at_gaps(log):
        assert not piece.recording.gaps and piece.steps >= 2


def _check_found(log: Log, done: dict) -> None:
    """What was done to a log that is otherwise whole is found, and nothing else."""
    kinds = Counter(one.kind for one in log.findings)
    if log.dt != 0.01:  # put on another grid
        return
    assert (kinds["gap"] > 0) == (done["gap"] > 0), (kinds, done)
    assert (kinds["stuck"] > 0) == (done["stuck"] > 0), (kinds, done)
    assert not kinds["dropped"] and not kinds["doubled"] and not kinds["missing rows"], kinds


def _check_files(rng: np.random.Generator, log: Log, table: dict[str, np.ndarray], folder: Path) -> None:
    """A log in a file is that in memory, and comes back from what is written of it."""
    for path in folder.iterdir():  # no log is written over
        path.unlink()
    write_columns(folder / "table.csv", table, "exact")
    assert read_log(folder / "table.csv", MODEL, dt=log.dt).digest == log.digest
    again = folder / f"again.{rng.choice(['csv', 'npz'])}"
    write_log(again, log)
    same = read_log(again, MODEL)
    np.testing.assert_array_equal(same.measurements, log.measurements)
    np.testing.assert_array_equal(same.inputs, log.inputs)


def _check_blocks(problem: LogProblem) -> None:
    parts, rows = problem.parts, {}
    for place, block in enumerate(parts.blocks):
        log, first = problem.logs[block.run], block.first + parts.lead
        assert 0 <= block.first and block.first + block.rows <= log.steps + 1
        some = range(first, block.first + block.rows)
        assert np.isfinite(log.measurements[some]).any(), "an empty block is scored"
        if not problem._holds:
            for gap, count in log.recording.gaps:
                assert block.first + block.rows <= gap or block.first >= gap + count, "a block with a gap"
        for row in some:
            assert rows.setdefault((block.run, row), place) == place, "a row that is scored twice"
    learnt = {problem.logs[parts.blocks[i].run].digest for i in parts.training}
    held = {problem.logs[parts.blocks[i].run] for i in parts.held_out}
    if len(problem.logs) >= 3:
        assert not learnt & {log.digest for log in held}, "what is held out is learnt from"
    assert problem.data(range(len(parts.blocks))).measurements.shape[0] == len(parts.blocks)
