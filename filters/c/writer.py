"""NAME.h and NAME.c of a filter: of mean and covariance, or of an ensemble."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from math import prod

import numpy as np

from filters.c.monitor import TestsWriter
from filters.c.programs import FilterPrograms
from filters.engine.belief import LARGEST
from thruster_env.core.angles import wrapped_where
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS
from thruster_env.graphs.programs import (
    Program,
    cut,
    functions_called_by,
    literal,
    statements_of,
    statements_of_members,
)
from thruster_env.model.quantities import Quantity
from thruster_env.model.shape import LANES, padded

LARGEST_FLOAT = 1e30  # what is LARGEST in single precision
TEST_ANEW = "    {name}_test_anew(filter);\n"
TEST_UPDATE = "    test_update(filter, z);\n"


class Writer:
    """Writes the files of one filter.

    Attributes:
        name, programs, single: of the filter.
        model: that it assumes.
        real: "double" or "float".
        tests: of innovations, or None.
        of_key, by_key: parameters and arguments of functions that take a random key.
    """

    includes = ""  # of NAME.h
    of_key = by_key = ""

    def __init__(self, name: str, programs: FilterPrograms, single: bool, tests: TestsWriter | None):
        self.name, self.programs, self.single, self.tests = name, programs, single, tests
        self.model, self.real = programs.model, "float" if single else "double"
        self.of_u = f", const {self.real} *u" if self.model.inputs else ""
        self.by_u = ", u" * (self.model.inputs > 0)

    def header(self, filter_name: str) -> str:
        """NAME.h."""
        name, model, real = self.name, self.model, self.real
        guard, n, m, t = name.upper(), model.n, model.m, model.t
        u, z = self._input_parameters()
        types, members, declared = (
            ("", "", "") if self.tests is None else (self.tests.types, self.tests.members, self.tests.declared)
        )
        return f"""\
/* The filter {filter_name}, {"single" if self.single else "double"} precision.

{_indented(self.programs.about)}

   Compile without -ffast-math, which takes NaN for a number. */
#ifndef {guard}_H
#define {guard}_H
{self.includes}
#ifdef __cplusplus
extern "C" {{
#endif

enum {{ {guard}_STATES = {n}, {guard}_INPUTS = {model.inputs}, {guard}_MEASUREMENTS = {model.channels} }};

{types}typedef struct {{
    {real} x[{n}];            /* estimate: {_listed(model.states)} */
    {real} P[{t * t}];            /* covariance of its error{", of 3 for each rotation" * (t < n)}, by rows */
    {real} innovation[{m}];   /* measurement minus its prediction: {_listed(model.measurements)}; 0 if missing */
    {real} S[{m * m}];            /* covariance of the innovation, by rows */
    {real} nis;             /* v' S^-1 v of the innovation v: chi-square of `channels` degrees of freedom */
    {real} log_likelihood;  /* log N(v; 0, S) */
{self.extra_members()}    int channels;           /* that were measured */
    unsigned long restarts; /* from the prior, after an estimate that was not finite or had a negative variance */
{members}}} {name};

/* Begin with the prior{" and a key: the same one gives the same random numbers" * bool(self.of_key)}. */
void {name}_init({name} *filter{self.of_key});

/* Predict a step{f", under u: {_listed(model.input_quantities)}" if model.inputs else ""}. */
void {name}_predict({name} *filter{u});

/* Correct by a measurement; a channel that is NaN is missing. */
void {name}_update({name} *filter{z});
{declared}
#ifdef __cplusplus
}}
#endif

#endif
"""

    def source(self) -> str:
        """NAME.c."""
        name, model, real = self.name, self.model, self.real
        n, m, t, zero = model.n, model.m, model.t, literal(0.0, self.single)
        magnitude = "fabsf" if self.single else "fabs"
        u, z = self._input_parameters()
        constants = "\n".join(self._array(key, np.ravel(value)) for key, value in self.constants().items())
        begin, test = ("", "") if self.tests is None else (TEST_ANEW.format(name=name), TEST_UPDATE)
        functions = "\n".join(functions_called_by(self.programs.all, self.single) + self.functions())
        return f"""\
#include "{name}.h"

#include <math.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "compile without -ffast-math, which takes NaN for a number and a quotient for a product"
#endif

{constants}

{functions}
static void become_prior({name} *filter)
{{
    for (int i = 0; i < {m}; i++) {{
        filter->innovation[i] = {zero};
    }}
    for (int i = 0; i < {m * m}; i++) {{
        filter->S[i] = R[i];
    }}
    filter->nis = {zero};
    filter->log_likelihood = {zero};
{self.prior()}}}

/* Whether a number is not finite, or a variance negative. */
static int is_lost(const {name} *filter)
{{
    {real} sum = {magnitude}(filter->log_likelihood);

    for (int i = 0; i < {n}; i++) {{
        sum += {magnitude}(filter->x[i]);
    }}
    for (int i = 0; i < {t}; i++) {{
        if (!(filter->P[i * {t + 1}] >= {zero})) {{
            return 1;
        }}
    }}
    for (int i = 0; i < {t * t}; i++) {{
        sum += {magnitude}(filter->P[i]);
    }}
    for (int i = 0; i < {m}; i++) {{
        sum += {magnitude}(filter->innovation[i]);
    }}
    for (int i = 0; i < {m * m}; i++) {{
        sum += {magnitude}(filter->S[i]);
    }}
    return !(sum < {literal(LARGEST_FLOAT if self.single else LARGEST, self.single)});
}}

{"" if self.tests is None else self.tests.functions}void {name}_init({name} *filter{self.of_key})
{{
{self.by_key}    become_prior(filter);
    filter->channels = 0;
    filter->restarts = 0;
{begin}}}

void {name}_predict({name} *filter{u})
{{
{self.predict()}}}

void {name}_update({name} *filter{z})
{{
{self.before_update()}    correct(filter, z);
    filter->channels = 0;
{self.counted()}    if (is_lost(filter)) {{
        become_prior(filter);
        filter->restarts++;
    }}
{test}}}
"""

    def extra_members(self) -> str:
        """The members of the struct for the filter's extras."""
        members = ""
        for name, shape in self.programs.extras.items():
            size = f"[{prod(shape)}]" * bool(shape)
            how = ", by rows" * (len(shape) == 2)
            members += f"    {self.real} {name}{size}; /* kept besides x and P{how} */\n"
        return members

    def constants(self) -> Mapping[str, np.ndarray]:
        """Arrays by their names."""
        model = self.model
        mean = wrapped_where(model.prior_mean, model.any_shape.state_angles)
        return {"prior_mean": mean, "prior_cov": model.prior_cov, "R": model.measurement_noise_cov}

    def functions(self) -> list[str]:
        """Functions of the programs."""
        programs, belief, real = self.programs, f"{self.name} *filter", self.real
        predicted = f", {real} *X" * bool(programs.predicted_size)
        advanced = f"{real} *x" if programs.points else belief + predicted
        return [
            *[self.function("start", belief, programs.start)] * bool(programs.extras),
            *[self.function("represent", belief + predicted, programs.represent)] * bool(programs.predicted_size),
            self.function("propagate", advanced + self.of_u, programs.propagate),
            self.function("add_process_noise", belief + predicted, programs.add_process_noise),
            self.function("correct", f"{belief}, const {real} *z", programs.update),
        ]

    def prior(self) -> str:
        """Statements that set the belief."""
        n, t, start = self.model.n, self.model.t, "    start(filter);\n" * bool(self.programs.extras)
        return f"""\
    for (int i = 0; i < {n}; i++) {{
        filter->x[i] = prior_mean[i];
    }}
    for (int i = 0; i < {t * t}; i++) {{
        filter->P[i] = prior_cov[i];
    }}
{start}"""

    def predict(self) -> str:
        """Statements of a step."""
        programs, n = self.programs, self.model.n
        points = ", X" * bool(programs.predicted_size)
        begin, step = "", f"        propagate(filter{points}{self.by_u});\n"
        if programs.predicted_size:
            begin = f"    {self.real} X[{programs.predicted_size}];\n\n    represent(filter, X);\n"
        if programs.points:
            move = f"            propagate(X + {n} * i{self.by_u});\n"
            step = f"        for (int i = 0; i < {programs.points}; i++) {{\n{move}        }}\n"
        loop = f"    for (int k = 0; k < {self.model.substeps}; k++) {{\n{step}    }}\n"
        return f"{begin}{loop}    add_process_noise(filter{points});\n"

    def counted(self) -> str:
        """Statements that count components of the innovation; a rotation with a missing number is missing."""
        lines, first = "", 0
        for turn in self.model.measured_turns:
            lines += self._counted_numbers(first, turn.stored)
            first = turn.stored + turn.size + 1
            missing = " || ".join(f"isnan(z[{i}])" for i in range(turn.stored, first))
            lines += f"    filter->channels += {missing} ? 0 : {turn.size};\n"
        return lines + self._counted_numbers(first, self.model.channels)

    @staticmethod
    def _counted_numbers(first: int, end: int) -> str:
        each = f"    for (int i = {first}; i < {end}; i++) {{\n        filter->channels += !isnan(z[i]);\n    }}\n"
        return each * (first < end)

    def before_update(self) -> str:
        """Statements before a correction."""
        return ""

    def statements(self, program: Program) -> list[str]:
        """A program in C."""
        return statements_of(program, self.single)

    def function(self, name: str, arguments: str, program: Program) -> str:
        """A function that runs a program."""
        lines = self.statements(program)
        used = set(re.findall(r"\w+", " ".join(lines)))
        unused = [argument for argument in re.findall(r"\*(\w+)", arguments) if argument not in used]
        body = "\n".join(f"    {line}" for line in [*(f"(void){argument};" for argument in unused), *lines])
        return f"static void {name}({arguments})\n{{\n{body}\n}}\n"

    def _input_parameters(self) -> list[str]:
        sizes = self.model.inputs, self.model.channels
        return [f", const {self.real} {key}[{size}]" * (size > 0) for key, size in zip("uz", sizes, strict=True)]

    def _array(self, name: str, values: np.ndarray) -> str:
        numbers = ", ".join(literal(float(value), self.single) for value in values)
        return f"static const {self.real} {name}[{len(values)}] = {{{numbers}}};"


def _listed(quantities: Iterable[Quantity]) -> str:
    return _plain(", ".join(quantity.short_label for quantity in quantities))


def _indented(text: str) -> str:
    return "\n".join(f"   {line}".rstrip() for line in _plain(text).splitlines())


def _plain(text: str) -> str:
    return text.encode("ascii", "replace").decode().replace("*/", "* /").replace("/*", "/ *")


DRAW = """\
/* Philox4x32-10 of a counter and a key (Salmon, Moraes, Dror, Shaw 2011). */
static void philox(uint32_t counter[4], uint32_t key_0, uint32_t key_1)
{{
    for (int i = 0; i < 10; i++) {{
        const uint64_t a = UINT64_C(0xD2511F53) * counter[0], b = UINT64_C(0xCD9E8D57) * counter[2];

        counter[0] = (uint32_t)(b >> 32) ^ counter[1] ^ key_0;
        counter[1] = (uint32_t)b;
        counter[2] = (uint32_t)(a >> 32) ^ counter[3] ^ key_1;
        counter[3] = (uint32_t)a;
        key_0 += UINT32_C(0x9E3779B9);
        key_1 += UINT32_C(0xBB67AE85);
    }}
}}

/* Rows of standard normals (Box, Muller 1958), which depend on the key, the stream and the step alone. */
static void draw({name} *filter, uint32_t stream, uint32_t rows)
{{
    for (uint32_t block = 0; block < rows * {width} / 4; block++) {{
        uint32_t words[4] = {{block, filter->step, stream, 0}};

        philox(words, filter->key[0], filter->key[1]);
        for (uint32_t i = 0; i < 4; i += 2) {{
            const {real} u = (({real})words[i] + {half}) * {unit};
            const {real} turns = (({real})words[i + 1] + {half}) * {unit} - {half};
            const {real} radius = {sqrt}({minus_two} * {log}(u));

            filter->normals[4 * block + i] = radius * {cos}({turn} * turns);
            filter->normals[4 * block + i + 1] = radius * {sin}({turn} * turns);
        }}
    }}
}}
"""


class EnsembleWriter(Writer):
    """Writes the files of an ensemble filter."""

    includes = "\n#include <stdint.h>\n"
    of_key = ", uint32_t key_0, uint32_t key_1"
    by_key = "    filter->key[0] = key_0;\n    filter->key[1] = key_1;\n    filter->step = 0;\n"

    def __init__(self, name: str, programs: FilterPrograms, single: bool, tests: TestsWriter | None):
        super().__init__(name, programs, single, tests)
        self._width = padded(programs.members, LANES)  # so that normals are those of Python
        self._rows = {"table": ("filter->members", programs.members), "draws": ("filter->normals", self._width)}

    def extra_members(self) -> str:
        """The members of the struct for the ensemble."""
        size, rows = self.programs.members, max(cut(program, self.model.n).rows for program in self.programs.all)
        normals = max(self.model.n, self.model.m) * self._width
        return f"""\
    {self.real} members[{rows * size}]; /* {size} of each state, one state behind the other; then scratch */
    {self.real} normals[{normals}]; /* scratch */
    uint32_t key[2];        /* with the step, what random numbers depend on */
    uint32_t step;          /* steps predicted */
{super().extra_members()}"""

    def constants(self) -> Mapping[str, np.ndarray]:
        """Arrays by their names."""
        return {"R": self.model.measurement_noise_cov}

    def functions(self) -> list[str]:
        """Functions of the programs, after those that draw."""
        programs, belief, real = self.programs, f"{self.name} *filter", self.real
        numbers = {"half": 0.5, "unit": 2.0**-32, "minus_two": -2.0, "turn": 2.0 * math.pi}
        words = {key: literal(value, self.single) for key, value in numbers.items()}
        words |= {key: key + "f" * self.single for key in ("sqrt", "log", "cos", "sin")}
        return [
            DRAW.format(name=self.name, real=real, width=self._width, **words),
            self.function("start", belief, programs.start),
            self.function("summarise", belief, programs.summarise),
            self.function("propagate", belief + self.of_u, programs.propagate),
            self.function("add_process_noise", belief, programs.add_process_noise),
            self.function("correct", f"{belief}, const {real} *z", programs.update),
        ]

    def prior(self) -> str:
        """Statements that draw the members."""
        return f"    draw(filter, {FILTER_PRIOR}, {self.model.n});\n    start(filter);\n    summarise(filter);\n"

    def predict(self) -> str:
        """Statements of a step."""
        drawn = f"    filter->step++;\n    draw(filter, {FILTER_PROCESS}, {self.model.n});\n"
        *substeps, add_noise = super().predict().splitlines(keepends=True)
        return "".join([*substeps, drawn, add_noise, "    summarise(filter);\n"])

    def before_update(self) -> str:
        """Normals for the update, where it draws any."""
        draws = any(source.array == "draws" for source, _ in self.programs.update.reads)
        return f"    draw(filter, {FILTER_MEASUREMENT}, {self.model.m});\n" * draws

    def statements(self, program: Program) -> list[str]:
        """A program in C, with loops over the members."""
        parts = cut(program, self.model.n)
        return statements_of_members(parts, self.programs.members, self._rows, self.single)
