"""A folder with a filter in C: NAME.h, NAME.c, NAME.hpp, a program that filters a log, and how to build them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from filters.c import board as emulated
from filters.c.cpp import class_of
from filters.c.log_program import log_program
from filters.c.monitor import TestsWriter
from filters.c.programs import programs_of
from filters.c.sizes import COMPILERS, Sizes, sizes_of
from filters.c.source import c_filter
from filters.filter import Filter
from filters.monitoring.monitor import Monitor, monitor_of
from thruster_env.core.files import check_target, write_whole

CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project({name} C)

set(CMAKE_C_STANDARD 99)
set(CMAKE_C_EXTENSIONS OFF)
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
`{name}.hpp` is a class of C++11 around it. `main.c` lists the columns of a log; other headers are given,
inputs first: `./{name}_log HEADER ...`.

| bytes with -Os | {compilers} |
|---|{rules}|
| struct | {struct} |
| stack, without that of math.h | {stack} |
| code and constants | {code} |

A prediction is {predict} operations of floating point, an update {update}. With another compiler:
`cc -std=c99 -Os -fstack-usage -c {name}.c && size {name}.o && cat {name}.su`.
{draws}{alarms}{board}"""
DRAWS = """
`{name}_init` takes a key, two words of 32 bits, from which all random numbers of the {members} members follow by
Philox4x32-10. The same key gives the estimates of `filter_.init(key)` in Python; drawing is not counted above.
Members, their random numbers and scratch lie in the struct. `-O3 -fno-math-errno` makes vector instructions of the
loops over members, and leaves the numbers as they are.
"""


def write_project(
    filter_: Filter,
    folder: str | Path,
    name: str | None = None,
    *,
    single: bool = False,
    monitor: Monitor | Mapping | float | None = None,
    board: bool = False,
    dt: float | None = None,
) -> list[Path]:
    """Write a filter in C, a program that filters a log with it, and how to build them; return the files.

    README.md has the bytes of the struct, of the stack and of the code for the compilers that are installed: gcc,
    and arm-none-eabi-gcc for a Cortex-M4.

    Args:
        filter_: as `c_filter` takes it, like the other arguments.
        folder: for the files; made if it is not there.
        name: of the filter; that of its type by default.
        single: floats in place of doubles.
        monitor: tests of the innovations, as wrappers take them.
        board: whether board.c and board.ld are written as well, for a Cortex-M4 that QEMU emulates.
        dt: sample time [s] of logs, whose missing rows the program then predicts; None for any without such rows.

    Raises:
        ValueError: as `c_filter`, for a wrong monitor, or if a file cannot be written.
    """
    watch = monitor_of(monitor)
    made, programs = c_filter(filter_, name, single=single, monitor=watch), programs_of(filter_)
    model = programs.model
    predict, update = programs.operations
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
        "predict": predict,
        "update": update,
        "draws": DRAWS.format(name=made.name, members=programs.members) if programs.members else "",
        "alarms": "" if watch is None else TestsWriter(watch, made.name, model.m, single).readme,
        "board": _of_board(made.name) if board else "",
    }
    texts = {
        f"{made.name}.h": made.header,
        f"{made.name}.c": made.source,
        f"{made.name}.hpp": class_of(made.name, programs, single=single, tested=watch is not None),
        "main.c": log_program(made.name, programs, single=single, tested=watch is not None, dt=dt),
        "CMakeLists.txt": CMAKE.format(name=made.name),
        "README.md": README.format(**about),
        **({"board.c": emulated.BOARD, "board.ld": emulated.MEMORY} if board else {}),
    }
    files = [Path(folder) / one for one in texts]
    for file in files:
        check_target(file)
    for file, text in zip(files, texts.values(), strict=True):
        write_whole(file, text)
    return files


def _of_board(name: str) -> str:
    """The part of the README on the emulated controller."""
    build = emulated.BUILD.format(name=name, flags="-std=c99 -O2")
    return emulated.README.format(build=build, emulate=emulated.EMULATE.format(name=name))
