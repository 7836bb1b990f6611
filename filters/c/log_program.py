"""A program in C that filters a log, row by row, beside a filter."""

from __future__ import annotations

from filters.c.programs import FilterPrograms
from filters.logs.columns import header_of
from filters.logs.estimate import SKIPPED
from thruster_env.numerics.streams import filter_keys
from thruster_env.plants.logs.columns import plain
from thruster_env.plants.logs.units import suffix
from thruster_env.plants.quantities import Quantity

MAIN = """\
/* Filter a log: a CSV with a row a step on standard input, estimates on standard output.

       @NAME@_log [HEADER ...] < log.csv > estimates.csv

   HEADER names the columns of the inputs, then of the measurements; without any they are those below. An input
   acts from its row on. An empty cell is a missing measurement.@ABOUT@ */
#include "@NAME@.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { INPUTS = @INPUTS@, CHANNELS = @CHANNELS@, COLUMNS = INPUTS + CHANNELS, STATES = @STATES@@TESTED@ };
enum { LONGEST = 65536 };

static const char *headers[COLUMNS] = {@HEADERS@};
static int column_of[COLUMNS];
static char line[LONGEST];

/* The next cell of a line, cut off from the rest; NULL behind the last one. */
static char *next_cell(char **rest)
{
    char *cell = *rest;

    if (cell != NULL) {
        char *end = strpbrk(cell, ",\\r\\n");
        *rest = end != NULL && *end == ',' ? end + 1 : NULL;
        if (end != NULL) {
            *end = '\\0';
        }
    }
    return cell;
}

static void show(double number)
{
    if (isnan(number)) {
        printf(",");
    } else {
        printf(",%.10g", number);
    }
}

int main(int count, char **words)
{
    @NAME@ filter;
    @REAL@ values[COLUMNS] = {0}, last[COLUMNS];
    char *rest = line, *cell;
    int time_column = -1;

    if (count != 1 && count != 1 + COLUMNS) {
        fprintf(stderr, "give no header, or %d, inputs first\\n", (int)COLUMNS);
        return 2;
    }
    if (fgets(line, LONGEST, stdin) == NULL) {
        fprintf(stderr, "a log must have a line of headers\\n");
        return 2;
    }
    for (int i = 0; i < COLUMNS; i++) {
        headers[i] = count > 1 ? words[1 + i] : headers[i];
        column_of[i] = -1;
    }
    for (int k = 0; (cell = next_cell(&rest)) != NULL; k++) {
        for (int i = 0; i < COLUMNS; i++) {
            column_of[i] = strcmp(cell, headers[i]) == 0 ? k : column_of[i];
        }
        time_column = strcmp(cell, "time_s") == 0 ? k : time_column;
    }
    for (int i = 0; i < COLUMNS; i++) {
        if (column_of[i] < 0) {
            fprintf(stderr, "a log must have a column %s, or its headers be given\\n", headers[i]);
            return 2;
        }
    }
    printf("time_s@TITLES@\\n");
    @NAME@_init(&filter@KEY@);
    for (long row = 0; fgets(line, LONGEST, stdin) != NULL; row++) {
        const char *time = "";

        rest = line;
        for (int i = 0; i < COLUMNS; i++) {
            last[i] = values[i];
            values[i] = (@REAL@)NAN;
        }
        for (int k = 0; (cell = next_cell(&rest)) != NULL; k++) {
            time = k == time_column ? cell : time;
            for (int i = 0; i < COLUMNS; i++) {
                if (column_of[i] == k && *cell != '\\0') {
                    values[i] = (@REAL@)strtod(cell, NULL);
                }
            }
        }
        if (row > 0) {
@CHECK@            @NAME@_predict(&filter@LAST@);
        }
@BEGIN@        @NAME@_update(&filter, values + INPUTS);
        printf("%s", time);
        for (int i = 0; i < STATES; i++) {
            show((double)filter.x[i]);
            show(sqrt((double)filter.P[i * (STATES + 1)]));
        }
        for (int i = 0; i < CHANNELS; i++) {
            show(isnan(values[INPUTS + i]) ? (double)NAN : (double)filter.innovation[i]);
            show(sqrt((double)filter.S[i * (CHANNELS + 1)]));
        }
@ALARMS@        printf("\\n");
    }
    return 0;
}
"""
CHECK = """\
            for (int i = 0; i < INPUTS; i++) {
                if (isnan(last[i])) {
                    fprintf(stderr, "row %ld has no %s\\n", row, headers[i]);
                    return 2;
                }
            }
"""


ABOUT = """ Columns alarm_... count the tests of a
   channel that raise an alarm, from row TESTED on."""
BEGIN = """\
        if (row == TESTED) {
            @NAME@_test_anew(&filter);
        }
"""
ALARMS = """\
        for (int i = 0; i < CHANNELS; i++) {
            int count = 0;
            for (unsigned some = row < TESTED ? 0 : filter.channel[i].alarms; some > 0; some >>= 1) {
                count += (int)(some & 1u);
            }
            show((double)count);
        }
"""


def log_program(name: str, programs: FilterPrograms, *, single: bool = False, tested: bool = False) -> str:
    """The source of the program for a filter in C of this name.

    An ensemble's random numbers are those of seed 0 in `thruster estimate`, whose columns are those of its output:
    the estimate and its standard deviation, then each innovation with its own. Where the filter tests its
    innovations, the number of alarms of each channel follows, from row 50 on, as with `--skip 50`.
    """
    model, key = programs.model, "".join(f", {int(word)}" for word in filter_keys([0])[0])
    pairs = [(model.states, ("", "std")), (model.measurements, ("innovation", "innovation_std"))]
    titles = [header_of(what, one) for some, kinds in pairs for one in some for what in kinds]
    titles += [header_of("alarm", one._replace(unit="")) for one in model.measurements if tested]
    headers = [_header(one) for one in (*model.input_quantities, *model.measurements)]
    words = {
        "ABOUT": ABOUT * tested,
        "BEGIN": BEGIN * tested,
        "ALARMS": ALARMS * tested,
        "TESTED": f", TESTED = {SKIPPED}" * tested,
        "CHECK": CHECK if model.inputs else "            (void)last;\n",
        "KEY": key * (programs.members > 0),
        "NAME": name,
        "REAL": "float" if single else "double",
        "INPUTS": str(model.inputs),
        "CHANNELS": str(model.m),
        "STATES": str(model.n),
        "HEADERS": ", ".join(f'"{_text(one)}"' for one in headers),
        "TITLES": _text("".join(f",{one}" for one in titles)).replace("%", "%%"),
        "LAST": ", last" * (model.inputs > 0),
    }
    found = MAIN
    for word, text in words.items():
        found = found.replace(f"@{word}@", text)
    return found


def _header(one: Quantity) -> str:
    """The header of a column as `thruster simulate` writes it: the name and the unit."""
    return "_".join(filter(None, (plain(one.name), suffix(one.unit))))


def _text(text: str) -> str:
    """Text within a string of C."""
    return text.encode("ascii", "replace").decode().replace("\\", "\\\\").replace('"', '\\"')
