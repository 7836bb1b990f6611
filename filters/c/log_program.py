"""A program in C that filters a log, row by row, beside a filter."""

from __future__ import annotations

from collections.abc import Iterable

from filters.c.log_columns import COLUMNS
from filters.c.log_reader import LINES, ROWS
from filters.c.programs import FilterPrograms
from filters.logs.estimate import SKIPPED
from filters.logs.findings import header_of
from thruster_env.core.streams import filter_keys
from thruster_env.logs import write
from thruster_env.logs.columns import DATE_NAMES, LENGTHS, TIME_NAMES, WORDS, conversion, plain
from thruster_env.model.quantities import Quantity

MAIN = """\
/* Filter a log: a CSV with a row a step on standard input, estimates on standard output.

       @NAME@_log [HEADER ...] < log.csv > estimates.csv

   HEADER names the columns of the inputs, then of the measurements, "HEADER[UNIT]" with another unit; without any
   they are those below, or others of the same name or symbol. An input acts from its row on, and is held where its
   cell is empty; an empty cell of a measurement is a missing one.@GAPS@ Text, infinite numbers, unknown units, and
   times off the steps end it with the number of the line. What else `thruster estimate` reads, such as dates,
   stamps in ms without a unit and irregular ones, `thruster log LOG --out log.csv` writes as this program takes
   it.@ABOUT@ */
#include "@NAME@.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { INPUTS = @INPUTS@, CHANNELS = @CHANNELS@, COLUMNS = INPUTS + CHANNELS, STATES = @STATES@@TESTED@ };
enum { LONGEST = 65536, MOST_CELLS = 4096, TIME = COLUMNS, FEWEST_ROWS = 3 };
#define LARGEST @LARGEST@
#define STEP @STEP@ /* [s], 0 where it is not known */
#define STEP_TEXT "@STEP@"

@TABLES@
@READER@
static void show(double number)
{
    if (isnan(number)) {
        printf(",");
    } else {
        printf(",%.@DIGITS@g", number);
    }
}

int main(int count, char **words)
{
    @NAME@ filter;
    @REAL@ values[COLUMNS] = {0}, last[COLUMNS];

    if (count != 1 && count != 1 + COLUMNS) {
        fprintf(stderr, "give no header, or %d, inputs first, and the log as standard input: < log.csv\\n",
                (int)COLUMNS);
        return 2;
    }
    if (!read_headers(count > 1 ? words + 1 : NULL)) {
        return 2;
    }
    printf("time_s@TITLES@\\n");
    @NAME@_init(&filter@KEY@);
    for (long row = 0, step = 0; read_row(row); row++) {
        for (; step <= step_of_row; step++) {
            for (int i = 0; i < COLUMNS; i++) {
                double number = step < step_of_row ? (double)NAN : numbers[i];
                last[i] = values[i];
                if (i >= INPUTS || !isnan(number)) {
                    values[i] = (@REAL@)number;
                }
            }
            if (step > 0) {
                @NAME@_predict(&filter@LAST@);
            }
@BEGIN@            @NAME@_update(&filter, values + INPUTS);
            show_time(step);
            for (int i = 0; i < STATES; i++) {
                show((double)filter.x[i]);
                show(sqrt((double)filter.P[i * (STATES + 1)]));
            }
            for (int i = 0; i < CHANNELS; i++) {
                show(isnan(values[INPUTS + i]) ? (double)NAN : (double)filter.innovation[i]);
                show(sqrt((double)filter.S[i * (CHANNELS + 1)]));
            }
@ALARMS@            printf("\\n");
        }
    }
    (void)last;
    return is_sound() ? 0 : 2;
}
"""

ABOUT = """ Columns alarm_... count the tests of a
   channel that raise an alarm, from row TESTED on."""
BEGIN = """\
            if (step == TESTED) {
                @NAME@_test_anew(&filter);
            }
"""
ALARMS = """\
            for (int i = 0; i < CHANNELS; i++) {
                int count = 0;
                for (unsigned some = step < TESTED ? 0 : filter.channel[i].alarms; some > 0; some >>= 1) {
                    count += (int)(some & 1u);
                }
                show((double)count);
            }
"""
GAPS = " Rows that are\n   missing by their times are predicted, as in `thruster estimate`."


def log_program(
    name: str, programs: FilterPrograms, *, single: bool = False, tested: bool = False, dt: float | None = None
) -> str:
    """The source of the program for a filter in C of this name.

    It reads numbers, missing values, units and times as `thruster_env.logs.read.read_log` does, or ends with
    exit code 2 and the number of the line. With dt [s], logs must have this sample time, and the program predicts
    over missing rows; without it, logs may have any sample time, but no missing rows. Output columns are those of
    `thruster estimate`: each estimate and innovation with its standard deviation, then, if the filter tests its
    innovations, each channel's number of alarms from row 50 on, as with `--skip 50`. An ensemble draws the random
    numbers of seed 0 there.
    """
    model, key = programs.model, "".join(f", {int(word)}" for word in filter_keys([0])[0])
    pairs = [(model.states, ("", "std")), (model.measurements, ("innovation", "innovation_std"))]
    titles = [
        header_of(what, quantity) for quantities, kinds in pairs for quantity in quantities for what in kinds
    ]
    titles += [header_of("alarm", quantity._replace(unit="")) for quantity in model.measurements if tested]
    words = {
        "ABOUT": ABOUT * tested,
        "BEGIN": BEGIN * tested,
        "ALARMS": ALARMS * tested,
        "GAPS": GAPS * (dt is not None),
        "STEP": repr(float(dt or 0.0)),
        "TESTED": f", TESTED = {SKIPPED}" * tested,
        "TABLES": _tables((*model.input_quantities, *model.measurements)),
        "READER": LINES + COLUMNS + ROWS,
        "KEY": key * (programs.members > 0),
        "NAME": name,
        "REAL": "float" if single else "double",
        "LARGEST": "FLT_MAX" if single else "DBL_MAX",
        "DIGITS": "9" if single else "15",
        "INPUTS": str(model.inputs),
        "CHANNELS": str(model.m),
        "STATES": str(model.n),
        "TITLES": _text("".join(f",{title}" for title in titles)).replace("%", "%%"),
        "LAST": ", last" * (model.inputs > 0),
    }
    source = MAIN
    for word, text in words.items():
        source = source.replace(f"@{word}@", text)
    return source


def _tables(quantities: tuple[Quantity, ...]) -> str:
    """The constants of the reader: headers, names and symbols of columns, and the units that it converts."""
    headers: dict[str, None] = {}
    names: list[str] = []
    for quantity in quantities:
        headers[write.header_of(quantity, headers)] = None
        name = plain(quantity.name).lower()
        names.append("" if name in names else name)  # of two quantities of one name the second has its symbol
    units = [*(quantity.unit for quantity in quantities), "s"]
    rates = [
        f"{over}/{under}{power}" for over in WORDS for under in ("s", "min", "h") for power in ("", "^2", "^3")
    ]
    rows = []
    for wanted in dict.fromkeys(units):
        for unit in dict.fromkeys([wanted, *WORDS, *rates]):
            known = (1.0, 1.0, 0.0) if unit == wanted else conversion(unit, wanted) if unit else None
            if unit and known is not None:
                rows.append(
                    f'    {{{units.index(wanted)}, "{_text(unit)}", {known[0]!r}, {known[1]!r}, {known[2]!r}}},'
                )
    firsts = ", ".join(str(units.index(unit)) for unit in units)
    return "\n".join(
        [
            _array("headers[COLUMNS]", headers),
            _array("names[COLUMNS]", names),
            _array("symbols[COLUMNS]", [plain(quantity.symbol) for quantity in quantities]),
            _array("time_names[]", [*TIME_NAMES, ""]),
            _array("date_names[]", [*DATE_NAMES, ""]),
            _array("known_units[]", [*WORDS, ""]),
            _array("lengths[]", [*LENGTHS, ""]),
            "/* Units by the first column that has them, the last for times: (number factor + zero)/divisor. */",
            f"static const int unit_of[COLUMNS + 1] = {{{firsts}}};",
            "static const struct {",
            "    int of;",
            "    const char *text;",
            "    double factor, divisor, zero;",
            "} units[] = {",
            *rows,
            "};",
        ]
    )


def _array(name: str, texts: Iterable[str]) -> str:
    lines, line = list[str](), "   "
    for entry in texts:
        word = f' "{_text(entry)}",'
        if len(line) + len(word) > 110:
            lines, line = [*lines, line], "   "
        line += word
    return f"static const char *const {name} = {{\n" + "\n".join([*lines, line]) + "\n};"


def _text(text: str) -> str:
    return "".join(
        f"\\{byte:03o}" if byte < 32 or byte > 126 or chr(byte) in '"\\?' else chr(byte) for byte in text.encode()
    )
