"""`tuning.export` and `thruster export`: a tuned filter as C code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from filters.c.programs import programs_of, single_error
from filters.c.project import c_filter, write_filter, write_project
from filters.monitoring import Monitor, monitor_of
from thruster_env.core.checks import one_of
from thruster_env.core.files import check_target
from tuning.api.estimate import monitor_for
from tuning.api.markers import OUTPUT, CodeProblem, Model, Option, Preset, TunedFile
from tuning.api.problems import given_for
from tuning.api.result import Result
from tuning.evaluation.tuned import read_tuned

LANGUAGES = ("c",)


@dataclass(frozen=True)
class Exported(Result):
    """The files of a filter in another language.

    Attributes:
        files: paths.
        single_error: the largest change of an estimate by single precision on a training run, in standard
            deviations; None in double precision.
    """

    files: list[str]
    single_error: float | None

    def tables(self) -> list[str]:
        """The files and what single precision changes, for a terminal."""
        lines = [f"wrote {path}" for path in self.files]
        if self.single_error is not None:
            changes = f"at most {self.single_error:.1g} standard deviations on a training run"
            lines.append(f"Single precision changes estimates by {changes}.")
        return lines

    def as_dict(self) -> dict[str, Any]:
        """The same as plain data, as in `thruster export --json`."""
        return asdict(self)


def export(
    tuned: TunedFile,
    out: Annotated[str | Path, Option(OUTPUT, metavar="FOLDER", type=Path)],
    *,
    language: Annotated[str, Option(OUTPUT)] = "c",
    name: Annotated[str | None, Option(OUTPUT)] = None,
    single: Annotated[bool, Option(OUTPUT)] = False,
    monitor: Annotated[Monitor | Mapping | float | str | None, Option(metavar="STEPS", type=str)] = None,
    board: Annotated[bool, Option(OUTPUT)] = False,
    problem: CodeProblem = None,
    model: Model = None,
    preset: Preset = None,
) -> Exported:
    """Write a tuned Kalman or ensemble filter as C99, with its model, Q and R, and a program that filters a log.

    All but gsf, imm, mmae and fuzzy can be exported. The code has fixed sizes and needs only math.h; it comes with
    a C++ class. `single` also computes the largest change of an estimate on a training run. Of rotations it writes
    the filter alone, without C++, program and that change; docs/attitude.md says how it begins.
    See docs/howto/export.md.

        tuning.export("tuned.json", "boat", name="bow")

    Example: thruster export out/ekf-mismatch-seed0.json --out boat

    Args:
        tuned: tuned file, as `thruster tune` writes it.
        out: folder for the files.
        language: only c.
        name: name of the C type and files; the filter's by default.
        single: single precision.
        monitor: test for outliers, biases, changed noise, stuck and missing readings, with one false alarm in this
            number of steps, or "tuned" for the tuned file's monitor (docs/monitoring.md). In Python also a
            `Monitor` or a mapping of its attributes.
        board: also write board.c and board.ld, for an emulated Cortex-M4.
        problem: the problem it was tuned on, if that is code: names in files and studies are never imported. In
            Python also a `Problem`.
        model: the model of the logs that it was tuned on, if that is code. In Python also what makes or offers
            one.
        preset: the preset with which it was tuned, by default as the tuned file names it:

    Returns:
        `Exported`: `files` and `single_error`.

    Raises:
        ValueError: if the filter cannot be exported, or a file cannot be read or written.
    """
    one_of("a language", language, LANGUAGES)
    watch = monitor_for(monitor, tuned)
    check_target(Path(out) / "README.md")
    choice, source, seed = read_tuned(tuned, given_for(tuned, problem, model, preset))
    filter_ = choice.filter(source)
    if filter_.model.turns and not board:
        generated = c_filter(filter_, name, single=single, monitor=monitor_of(watch))
        return Exported([str(path) for path in write_filter(generated, out)], None)
    options: dict[str, Any] = {"single": single, "monitor": watch, "board": board, "dt": source.dt}
    files = [str(path) for path in write_project(filter_, out, name, **options)]
    if not single:
        return Exported(files, None)
    data = source.data(source.training_seeds(seed, 2)[:1])
    return Exported(files, single_error(filter_, programs_of(filter_), data.inputs[0], data.measurements[0]))
