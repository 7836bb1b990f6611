"""NAME.h and NAME.c of a filter."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from inspect import cleandoc
from math import prod
from typing import NamedTuple

import numpy as np

from filters.c.programs import FilterPrograms, is_name, programs_of
from filters.engine.restart import LARGEST
from filters.filter import Filter
from thruster_env.numerics.algebra.c_source import literal, statements_of
from thruster_env.numerics.algebra.programs import Program
from thruster_env.numerics.angles import wrapped_where
from thruster_env.plants.quantities import Quantity

LARGEST_FLOAT = 1e30  # what is LARGEST in single precision


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


def c_filter(filter_: Filter, name: str | None = None, *, single: bool = False) -> CFilter:
    """A filter as C99, from its page and its model's functions, with the model's numbers in it.

    NAME_init sets the prior, NAME_predict(filter, u) is a step, NAME_update(filter, z) corrects by a measurement
    whose channels may be NaN. The estimates are those of `filters.run` to rounding, restarts included. The code
    has fixed sizes, no heap and no recursion, and needs math.h alone.

    Args:
        filter_: a filter with a page, any Kalman filter but "gsf" and "fuzzy".
        name: of the type, and before all names; the filter's by default.
        single: floats in place of doubles.

    Raises:
        ValueError: for another filter, a name that C does not take, or a model whose functions decide, look
            numbers up, or have too many operations.
    """
    name = filter_.name.replace("-", "_") if name is None else name
    if not is_name(name):
        raise ValueError(f"a name in C must be letters, digits and _, and no keyword, but got {name!r}")
    programs = programs_of(filter_)
    writer = _Writer(name, programs, single)
    return CFilter(name, writer.header(filter_), writer.source())


class _Writer:
    """Writes the files of one filter."""

    def __init__(self, name: str, programs: FilterPrograms, single: bool):
        self._name, self._programs, self._single = name, programs, single
        self._model, self._real = programs.model, "float" if single else "double"
        self._u = f", const {self._real} *u" if self._model.inputs else ""
        sizes = self._model.inputs, self._model.m
        self._given = [
            f", const {self._real} {key}[{size}]" * (size > 0) for key, size in zip("uz", sizes, strict=True)
        ]

    def header(self, filter_: Filter) -> str:
        name, model, real, page = (
            self._name,
            self._model,
            self._real,
            sys.modules[self._programs.page].__doc__ or "",
        )
        guard, n, m = f"{name.upper()}_H", model.n, model.m
        u, z = self._given
        return f"""\
/* The filter {filter_.name}, {"single" if self._single else "double"} precision.

{_indented(cleandoc(page))}

   Compile without -ffast-math, which takes NaN for a number. */
#ifndef {guard}
#define {guard}

#ifdef __cplusplus
extern "C" {{
#endif

enum {{ {name.upper()}_STATES = {n}, {name.upper()}_INPUTS = {model.inputs}, {name.upper()}_MEASUREMENTS = {m} }};

typedef struct {{
    {real} x[{n}];            /* estimate: {_listed(model.states)} */
    {real} P[{n * n}];            /* covariance of its error, by rows */
    {real} innovation[{m}];   /* measurement minus its prediction: {_listed(model.measurements)}; 0 if missing */
    {real} S[{m * m}];            /* covariance of the innovation, by rows */
    {real} nis;             /* v' S^-1 v of the innovation v: chi-square of `channels` degrees of freedom */
    {real} log_likelihood;  /* log N(v; 0, S) */
{self._kept()}    int channels;           /* that were measured */
    unsigned long restarts; /* from the prior, after an estimate that was not finite or had a negative variance */
}} {name};

/* Begin with the prior. */
void {name}_init({name} *filter);

/* Predict a step{f", under u: {_listed(model.input_quantities)}" if model.inputs else ""}. */
void {name}_predict({name} *filter{u});

/* Correct by a measurement; a channel that is NaN is missing. */
void {name}_update({name} *filter{z});

#ifdef __cplusplus
}}
#endif

#endif
"""

    def _kept(self) -> str:
        """The members of the struct for what the filter keeps besides."""
        members = ""
        for name, shape in self._programs.kept.items():
            size = f"[{prod(shape)}]" * bool(shape)
            how = ", by rows" * (len(shape) == 2)
            members += f"    {self._real} {name}{size}; /* kept besides x and P{how} */\n"
        return members

    def source(self) -> str:
        name, model, real, programs = self._name, self._model, self._real, self._programs
        n, m, zero = model.n, model.m, literal(0.0, self._single)
        magnitude = "fabsf" if self._single else "fabs"
        mean = wrapped_where(model.prior_mean, model.shape.state_angles)
        arrays = {"prior_mean": mean, "prior_cov": model.prior_cov, "R": model.measurement_noise_cov}
        (u, z), of_u = self._given, ", u" * (model.inputs > 0)
        belief, points = f"{name} *filter", programs.points
        predicted, flying = (f", {real} *X", ", X") if programs.flying else ("", "")
        functions = [self._function("advance", f"{belief}{predicted}{self._u}", programs.advance)]
        functions.append(self._function("settle", f"{belief}{predicted}", programs.settle))
        functions.append(self._function("correct", f"{belief}, const {real} *z", programs.update))
        begin, step = "", f"        advance(filter{flying}{of_u});\n"
        if programs.flying:
            functions.insert(0, self._function("begin", f"{belief}{predicted}", programs.begin))
            begin = f"    {real} X[{programs.flying}];\n\n    begin(filter, X);\n"
        if points:
            functions[1] = self._function("advance", f"{real} *x{self._u}", programs.advance)
            move = f"            advance(X + {n} * i{of_u});\n"
            step = f"        for (int i = 0; i < {points}; i++) {{\n{move}        }}\n"
        start = ""
        if programs.kept:
            functions.insert(0, self._function("start", belief, programs.start))
            start = "    start(filter);\n"
        written = "\n".join(functions)
        constants = "\n".join(self._array(key, np.ravel(value)) for key, value in arrays.items())
        return f"""\
#include "{name}.h"

#include <math.h>

{constants}

{written}
static void become_prior({name} *filter)
{{
    for (int i = 0; i < {n}; i++) {{
        filter->x[i] = prior_mean[i];
    }}
    for (int i = 0; i < {n * n}; i++) {{
        filter->P[i] = prior_cov[i];
    }}
    for (int i = 0; i < {m}; i++) {{
        filter->innovation[i] = {zero};
    }}
    for (int i = 0; i < {m * m}; i++) {{
        filter->S[i] = R[i];
    }}
    filter->nis = {zero};
    filter->log_likelihood = {zero};
{start}}}

/* Whether a number is not finite, or a variance negative. */
static int is_lost(const {name} *filter)
{{
    {real} sum = {magnitude}(filter->log_likelihood);

    for (int i = 0; i < {n}; i++) {{
        sum += {magnitude}(filter->x[i]);
        if (!(filter->P[i * {n + 1}] >= {zero})) {{
            return 1;
        }}
    }}
    for (int i = 0; i < {n * n}; i++) {{
        sum += {magnitude}(filter->P[i]);
    }}
    for (int i = 0; i < {m}; i++) {{
        sum += {magnitude}(filter->innovation[i]);
    }}
    for (int i = 0; i < {m * m}; i++) {{
        sum += {magnitude}(filter->S[i]);
    }}
    return !(sum < {literal(LARGEST_FLOAT if self._single else LARGEST, self._single)});
}}

void {name}_init({name} *filter)
{{
    become_prior(filter);
    filter->channels = 0;
    filter->restarts = 0;
}}

void {name}_predict({name} *filter{u})
{{
{begin}    for (int k = 0; k < {model.substeps}; k++) {{
{step}    }}
    settle(filter{flying});
}}

void {name}_update({name} *filter{z})
{{
    correct(filter, z);
    filter->channels = 0;
    for (int i = 0; i < {m}; i++) {{
        filter->channels += !isnan(z[i]);
    }}
    if (is_lost(filter)) {{
        become_prior(filter);
        filter->restarts++;
    }}
}}
"""

    def _function(self, name: str, arguments: str, program: Program) -> str:
        lines = statements_of(program, self._single)
        used = set(re.findall(r"\w+", " ".join(lines)))
        unused = [one for one in re.findall(r"\*(\w+)", arguments) if one not in used]
        body = "\n".join(f"    {line}" for line in [*(f"(void){one};" for one in unused), *lines])
        return f"static void {name}({arguments})\n{{\n{body}\n}}\n"

    def _array(self, name: str, values: np.ndarray) -> str:
        numbers = ", ".join(literal(float(value), self._single) for value in values)
        return f"static const {self._real} {name}[{len(values)}] = {{{numbers}}};"


def _listed(quantities: Iterable[Quantity]) -> str:
    return _plain(", ".join(one.short_label for one in quantities))


def _indented(text: str) -> str:
    return "\n".join(f"   {line}".rstrip() for line in _plain(text).splitlines())


def _plain(text: str) -> str:
    """Text for a comment."""
    return text.encode("ascii", "replace").decode().replace("*/", "* /")
