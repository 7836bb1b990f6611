"""A folder with a filter in C: NAME.h, NAME.c, a program that filters a log, CMakeLists.txt and README.md."""

from __future__ import annotations

from pathlib import Path

from filters.c.log_program import log_program
from filters.c.programs import programs_of
from filters.c.source import c_filter
from filters.filter import Filter
from numerics.files import check_target, write_whole

CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project({name} C)

set(CMAKE_C_STANDARD 99)
add_library({name} STATIC {name}.c)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
target_link_libraries({name} PUBLIC m)
add_executable({name}_log main.c)
target_link_libraries({name}_log PRIVATE {name})
"""
README = """\
# The filter {filter} in C99, {precision} precision

{states}

    cc -std=c99 -O2 {name}.c main.c -lm -o {name}_log
    ./{name}_log < log.csv > estimates.csv

or `cmake -B build && cmake --build build`. Do not compile with -ffast-math, which takes NaN for a number.
`{name}.h` says what each function does; there is no heap and no recursion, and of libraries math.h alone.

| | |
|---|--:|
| memory of a filter | about {memory} bytes |
| operations of a prediction | {predict} |
| operations of an update | {update} |

Code and stack: `cc -std=c99 -Os -fstack-usage -c {name}.c && size {name}.o && cat {name}.su`, with the compiler
of the controller.
"""


def write_project(
    filter_: Filter, folder: str | Path, name: str | None = None, *, single: bool = False
) -> list[Path]:
    """Write a filter in C, a program that filters a log with it, and how to build them; return the files.

    Args:
        filter_: as `c_filter` takes it, like the other arguments.
        folder: for the files; made if it is not there.
        name: of the filter; that of its type by default.
        single: floats in place of doubles.

    Raises:
        ValueError: as `c_filter`, or if a file cannot be written.
    """
    made, programs = c_filter(filter_, name, single=single), programs_of(filter_)
    model, n, m = programs.model, programs.model.n, programs.model.m
    points = programs.points or 1
    steps = [programs.advance.operations * points * model.substeps, programs.settle.operations]
    steps.append(0 if programs.begin is None else programs.begin.operations)
    labels = (", ".join(one.short_label for one in some) or "none" for some in model.quantities)
    about = {
        "name": made.name,
        "filter": filter_.name,
        "precision": "single" if single else "double",
        "states": "State: {}. Inputs: {}. Measurements: {}.".format(*labels),
        "memory": (n + n * n + m + m * m + 2) * (4 if single else 8) + 16,
        "predict": sum(steps),
        "update": programs.update.operations,
    }
    texts = {
        f"{made.name}.h": made.header,
        f"{made.name}.c": made.source,
        "main.c": log_program(made.name, model, single=single),
        "CMakeLists.txt": CMAKE.format(name=made.name),
        "README.md": README.format(**about),
    }
    files = [Path(folder) / one for one in texts]
    for file in files:
        check_target(file)
    for file, text in zip(files, texts.values(), strict=True):
        write_whole(file, text)
    return files
