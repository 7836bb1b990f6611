"""NAME.h and NAME.c of a filter."""

from __future__ import annotations

from typing import NamedTuple

from filters.c.ensemble import EnsembleWriter
from filters.c.monitor import TestsWriter
from filters.c.programs import is_name, programs_of
from filters.c.writer import Writer
from filters.filter import Filter
from filters.monitoring.monitor import Monitor


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
    tests = None if monitor is None else TestsWriter(monitor, name, programs.model.m, single)
    writer = (EnsembleWriter if programs.members else Writer)(name, programs, single, tests)
    return CFilter(name, writer.header(filter_.name), writer.source())
