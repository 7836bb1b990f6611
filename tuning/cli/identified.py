"""What `thruster identify` prints and writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import RenderableType

from thruster_env.core.plots import save_figure
from thruster_env.core.text_tables import table
from thruster_env.logs.log import Log
from tuning.identification.profiles import Profile, profile_figure
from tuning.identification.result import Identification
from tuning.identification.validation import Validation, fall_sentence
from tuning.logs.identify import remarks, write_found
from tuning.search.parameters import index_pairs


def report(
    found: Identification,
    checked: Mapping[str, Validation],
    runs: Sequence[Log],
    proving: Sequence[Log],
    files: Sequence[str],
) -> list[RenderableType]:
    """Tables and sentences for the terminal."""
    units = {one.name: one.unit for one in found.objective.coordinates.free}
    rows = []
    for name in found.names:
        known = "yes" if found.determined[name] else "at the end" if found.at_end[name] else "no"
        numbers = found.start[name], found.values[name], found.standard_errors[name]
        test = found.null_tests.get(name)
        without = ["-", "-"] if test is None else [f"{test.at:.4g}", test.said]
        label = index_pairs(name) + (f" [{units[name]}]" if units[name] else "")
        rows.append([label, *(f"{v:.5g}" for v in numbers), known, *without])
    count, steps = len(runs), sum(log.steps for log in runs)
    title = f"Identified on {count} run{'' if count == 1 else 's'}, {steps} steps"
    shown = [table(title, ["", "start", "value", "standard\nerror", "determined", "if left\nout, at", "p"], rows)]
    where = (
        f"Validation on {'; '.join(log.name for log in proving)}"
        if proving
        else "On the runs used for identification"
    )
    rows = []
    for symbol in checked["start"].one_step:
        for what, part in (("one step", "one_step"), ("simulation", "simulation")):
            rows.append(
                [f"RMSE, {what}, {symbol}", *(f"{getattr(v, part)[symbol]:.4g}" for v in checked.values())]
            )
        rows.append([f"fit of the simulation, {symbol} [%]", *(f"{v.fit[symbol]:.1f}" for v in checked.values())])
    rows.append(["mean NIS over channels", *(f"{v.nis:.3g}" for v in checked.values())])
    rows.append(["log-likelihood", *(f"{v.log_likelihood:.6g}" for v in checked.values())])
    shown.append(table(where, ["", *checked], rows))
    return [
        *shown,
        *found.sentences(),
        *(fall_sentence(checked) if proving else []),
        *remarks(runs, proving, found),
        *(f"wrote {path}" for path in files),
    ]


def write_files(
    found: Identification,
    family,
    made: Sequence[Profile],
    out: Path | None,
    plot: Path | None,
    logs: Sequence[str],
) -> list[str]:
    """Write the preset file of a thruster or the values of a model, and the profiles; return the paths."""
    files = []
    if out is not None:
        write_found(out, found, family, logs)
        files.append(str(out))
    if plot is not None and made:
        save_figure(profile_figure(found, made), plot)
        files.append(str(plot))
    return files


def as_json(
    found: Identification,
    checked: Mapping[str, Validation],
    made: Sequence[Profile],
    runs: Sequence[Log],
    proving: Sequence[Log],
    files: Sequence[str],
) -> dict:
    """The result as plain data."""
    return {
        "logs": [log.name for log in runs],
        "held_out": [log.name for log in proving],
        "values": found.values,
        "start": found.start,
        "standard_errors": found.standard_errors,
        "determined": found.determined,
        "at_end": found.at_end,
        "left_out": {name: one._asdict() for name, one in found.null_tests.items()},
        "begun_elsewhere": [runs[place].name for place in found.begun_elsewhere],
        "correlations": {"names": found.names, "matrix": found.correlations},
        "trade_off": found.traded,
        "least_known_direction": found.least_determined,
        "log_likelihood": found.log_likelihood,
        "log_likelihood_at_start": found.start_log_likelihood,
        "optima": [one._asdict() for one in found.optima],
        "starts_that_agree": found.agreement,
        "evaluations": found.evaluations,
        "samples_left_out": found.left_out,
        "interrupted": found.interrupted,
        "validation": {name: one._asdict() for name, one in checked.items()},
        "profiles": [{**one._asdict(), "interval": one.interval} for one in made],
        "sentences": [
            *found.sentences(),
            *(fall_sentence(checked) if proving else []),
            *remarks(runs, proving, found),
        ],
        "files": list(files),
    }
