"""A folder with a filter in C: NAME.h, NAME.c, NAME.hpp, a program that filters a log, and how to build them."""

from __future__ import annotations

from pathlib import Path

from filters.c.cpp import class_of
from filters.c.log_program import log_program
from filters.c.programs import programs_of
from filters.c.sizes import COMPILERS, Sizes, sizes_of
from filters.c.source import c_filter
from filters.filter import Filter
from thruster_env.numerics.files import check_target, write_whole

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
LABELS = {"gcc": "this computer's gcc", "arm-none-eabi-gcc": "Cortex-M4"}
README = """\
# The filter {filter} in C99, {precision} precision

{states}

    cc -std=c99 -O2 {name}.c main.c -lm -o {name}_log
    ./{name}_log < log.csv > estimates.csv

or `cmake -B build && cmake --build build`. Do not compile with -ffast-math, which takes NaN for a number.
`{name}.h` says what each function does; there is no heap and no recursion, and of libraries math.h alone.
`{name}.hpp` is a class of C++11 around it.

| bytes with -Os | {compilers} |
|---|{rules}|
| struct | {struct} |
| stack, without that of math.h | {stack} |
| code and constants | {code} |

A prediction is {predict} operations of floating point, an update {update}. With another compiler:
`cc -std=c99 -Os -fstack-usage -c {name}.c && size {name}.o && cat {name}.su`.
"""


def write_project(
    filter_: Filter, folder: str | Path, name: str | None = None, *, single: bool = False
) -> list[Path]:
    """Write a filter in C, a program that filters a log with it, and how to build them; return the files.

    README.md has the bytes of the struct, of the stack and of the code for the compilers that are installed: gcc,
    and arm-none-eabi-gcc for a Cortex-M4.

    Args:
        filter_: as `c_filter` takes it, like the other arguments.
        folder: for the files; made if it is not there.
        name: of the filter; that of its type by default.
        single: floats in place of doubles.

    Raises:
        ValueError: as `c_filter`, or if a file cannot be written.
    """
    made, programs = c_filter(filter_, name, single=single), programs_of(filter_)
    model = programs.model
    substeps = model.substeps * max(programs.points, 1)
    steps = [programs.begin.operations, programs.advance.operations * substeps, programs.settle.operations]
    sizes = {one: found for one in COMPILERS if (found := sizes_of(made, one)) is not None}
    labels = (", ".join(one.short_label for one in some) or "none" for some in model.quantities)
    about = {
        "name": made.name,
        "filter": filter_.name,
        "precision": "single" if single else "double",
        "states": "State: {}. Inputs: {}. Measurements: {}.".format(*labels),
        "compilers": " | ".join(LABELS[one] for one in sizes) or "any",
        "rules": "|".join("--:" for _ in sizes) or "--:",
        **{
            key: " | ".join(str(getattr(one, key)) for one in sizes.values()) or "not measured"
            for key in Sizes._fields
        },
        "predict": sum(steps),
        "update": programs.update.operations,
    }
    texts = {
        f"{made.name}.h": made.header,
        f"{made.name}.c": made.source,
        f"{made.name}.hpp": class_of(made.name, programs, single=single),
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
