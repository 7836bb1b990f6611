"""`tuning.fit` and `thruster fit`: which model, Q and R a column of numbers has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from filters.named import AUTO
from thruster_env.core.checks import short_repr
from thruster_env.core.files import check_target, save_figure, write_whole
from thruster_env.logs.write import check_picture
from tuning.api.markers import INPUT, READ, Argument, Option, Progress, PythonOnly, WrittenFile
from tuning.api.progress import console_for
from tuning.series.answer import SeriesFit, choose_among_all
from tuning.series.column import Column, column_of
from tuning.series.fit import choose
from tuning.series.outliers import without_outliers
from tuning.series.paste import LANGUAGES


def fit(
    z: Annotated[Any, Argument(INPUT, ("--log",), "FILE", str, file=READ)],
    dt: Annotated[Any, Option(INPUT, type=float)] = None,
    *,
    times: Annotated[Any, PythonOnly()] = None,
    column: Annotated[Any, Option(INPUT, metavar="HEADER", type=str)] = None,
    model: Annotated[str, Option(INPUT)] = AUTO,
    plot: WrittenFile = None,
    code: WrittenFile = None,
    progress: Progress = None,
) -> SeriesFit:
    """Find the model, Q and R of a column of numbers, or of a track with several axes, by maximum likelihood.

    Each model is a plant that everybody knows, driven by white noise: constant, constant-velocity,
    constant-acceleration, local-trend, ornstein-uhlenbeck, singer, oscillator, harmonic, seasonal:period=12 or
    ar:2. Axes are independent and have the same numbers. Of the models that predict unseen blocks of the record as
    well as the best one, the simplest is chosen. If innovations are correlated, the first line says that no model
    fits.

        fit = tuning.fit(z, dt=0.1)
        print(fit)
        filter_ = fit.filter
        print(fit.code("arduino"))

    Example: thruster fit acc.csv

    Example: thruster fit acc.csv --model constant-velocity --plot acc.png --code acc.md

    Args:
        z: a log with one column of numbers, and times. In Python also an array (K,) or (K, axes) or list, a pandas
            Series or table, whose index may have times or dates; NaN or None where a number is missing.
        dt: sample time [s], where there are no times; 1 by default. In Python also the steps between numbers.
        times: of an array's numbers [s], (K,).
        column: header of the numbers, where there are several; x,y for the axes of a track; level,time=HEADER
            names that of the times, too.
        model: name of a model, or a sum such as "constant-velocity + oscillator"; auto tries the small ones.
        plot: also draw the data, the estimate with its band, and the innovations: .png, .svg or .pdf.
        code: also write the filter as lines to paste, for Python, FilterPy, pykalman, MATLAB, a controller: .md.
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `SeriesFit`: `filter`, `model`, `q`, `r`, `gain`, `numbers` with intervals, `sentences()`, `to_frame()`,
        `plot()`, `code(language)`.

    Raises:
        ValueError: for fewer than 20 numbers, numbers that do not vary, times that go back, or an unknown model.
    """
    if plot is not None:
        check_picture(plot, "--plot")
        check_target(plot)
    if code is not None:
        if Path(code).suffix != ".md":
            raise ValueError(f"code (--code) must be a file that ends in .md, but got {str(code)!r}")
        check_target(code)
    if not isinstance(model, str):
        raise ValueError(f"model (--model) must be {AUTO}, or a model's name, but got {short_repr(model)}")
    data = column_of(z, dt, times=times, column=column)
    with console_for(progress).status("fitting ...") as status:

        def fitting(name: str) -> None:
            status.update(f"fitting {name} ...")

        is_auto = model.strip().lower() == AUTO

        def answer(column: Column) -> SeriesFit:
            choice = choose_among_all(column, fitting) if is_auto else choose(column, (model,), fitting)
            return SeriesFit(column, *choice)

        fitted = without_outliers(data, answer)
    if plot is not None:
        save_figure(fitted.plot(), plot)
    if code is not None:
        write_whole(code, "\n".join(_section(fitted, name) for name in LANGUAGES))
    files = tuple(str(path) for path in (plot, code) if path is not None)
    return replace(fitted, files=files) if files else fitted


def _section(fitted: SeriesFit, language: str) -> str:
    """The filter in a language as a section of Markdown, or why there is none."""
    try:
        body = f"```\n{fitted.code(language)}\n```"
    except ValueError as error:
        body = f"None: {error}."
    return f"## {language}\n\n{body}\n"
