"""NAME.h and NAME.c of a filter."""

from __future__ import annotations

from typing import NamedTuple

from filters.c.cpp import class_of
from filters.c.ensemble import EnsembleWriter
from filters.c.identifiers import is_name, is_taken
from filters.c.log_program import log_program
from filters.c.monitor import TestsWriter
from filters.c.programs import programs_of
from filters.c.writer import Writer
from filters.filter import Filter
from filters.monitoring.monitor import Monitor

STAND_IN = "another_name"  # of a filter whose own words are asked for


class CFilter(NamedTuple):
    """A filter in C.

    Attributes:
        name: of its type and its files.
        header: NAME.h.
        source: NAME.c.
    """

    name: str
    header: str
    source: str


def c_filter(
    filter_: Filter, name: str | None = None, *, single: bool = False, monitor: Monitor | None = None
) -> CFilter:
    """A filter as C99, from its page and its model's functions, with the model's numbers in it.

    NAME_init sets the prior, NAME_predict(filter, u) is a step, NAME_update(filter, z) corrects by a measurement
    whose channels may be NaN. The estimates are those of `filters.run` to rounding, restarts included; an ensemble
    draws the same numbers from the same key, which NAME_init takes. The code has fixed sizes, no heap and no
    recursion, and needs math.h alone.

    Args:
        filter_: a filter with a page, so no "gsf", "imm", "mmae", "mhe" or "fuzzy".
        name: of the type, and before all names; the filter's by default.
        single: floats in place of doubles.
        monitor: tests of the innovations, which run after each update.

    Raises:
        ValueError: for another filter, a name that C does not take, or a model whose functions decide, look
            numbers up, or have too many operations.
    """
    name = filter_.name.replace("-", "_") if name is None else name
    if not is_name(name):
        raise ValueError(f"a name in C must be letters, digits and _, and no keyword, but got {name!r}")
    programs = programs_of(filter_)

    def called(name: str) -> CFilter:
        tests = None if monitor is None else TestsWriter(monitor, name, programs.model.m, single)
        writer = (EnsembleWriter if programs.members else Writer)(name, programs, single, tests)
        return CFilter(name, writer.header(filter_.name), writer.source())

    _, *texts = called(STAND_IN)
    texts.append(class_of(STAND_IN, programs, single=single, tested=monitor is not None))
    texts.append(log_program(STAND_IN, programs, single=single, tested=monitor is not None))
    if is_taken(name, texts):
        raise ValueError(
            "a name in C must be one that neither its libraries nor the filter's own files use, but got "
            f"{name!r}: take another one, such as {name}_filter"
        )
    return called(name)
