"""NAME.h and NAME.c of an ensemble filter: loops over its members, and the normals that they are moved by."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from filters.c.monitor import TestsWriter
from filters.c.programs import FilterPrograms
from filters.c.writer import Writer
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS
from thruster_env.graphs.c_source import literal, statements_of_members
from thruster_env.graphs.loops import cut
from thruster_env.graphs.programs import Program
from thruster_env.model.layout import LANES, padded

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
        """Take a filter."""
        super().__init__(name, programs, single, tests)
        self._width = padded(programs.members, LANES)  # so that normals are those of Python
        self._rows = {"table": ("filter->members", programs.members), "draws": ("filter->normals", self._width)}

    def kept(self) -> str:
        """The members of the struct for the ensemble."""
        size, rows = self.programs.members, max(cut(one, self.model.n).rows for one in self.programs.all)
        normals = max(self.model.n, self.model.m) * self._width
        return f"""\
    {self.real} members[{rows * size}]; /* {size} of each state, one state behind the other; then scratch */
    {self.real} normals[{normals}]; /* scratch */
    uint32_t key[2];        /* with the step, what random numbers depend on */
    uint32_t step;          /* steps predicted */
{super().kept()}"""

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
            self.function("advance", belief + self.of_u, programs.advance),
            self.function("settle", belief, programs.settle),
            self.function("correct", f"{belief}, const {real} *z", programs.update),
        ]

    def prior(self) -> str:
        """Statements that draw the members."""
        return f"    draw(filter, {FILTER_PRIOR}, {self.model.n});\n    start(filter);\n    summarise(filter);\n"

    def predict(self) -> str:
        """Statements of a step."""
        drawn = f"    filter->step++;\n    draw(filter, {FILTER_PROCESS}, {self.model.n});\n"
        *substeps, settle = super().predict().splitlines(keepends=True)
        return "".join([*substeps, drawn, settle, "    summarise(filter);\n"])

    def before_update(self) -> str:
        """Normals for the update, where it draws any."""
        draws = any(place.array == "draws" for place, _ in self.programs.update.reads)
        return f"    draw(filter, {FILTER_MEASUREMENT}, {self.model.m});\n" * draws

    def statements(self, program: Program) -> list[str]:
        """A program in C, with loops over the members."""
        parts = cut(program, self.model.n)
        return statements_of_members(parts, self.programs.members, self._rows, self.single)
