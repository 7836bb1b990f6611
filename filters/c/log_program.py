"""A C program that filters a log, row by row: its columns by their headers and units, and its loop."""

from __future__ import annotations

from collections.abc import Iterable

from filters.c.log_reader import LINES, ROWS
from filters.c.programs import FilterPrograms
from filters.logs.estimate import SKIPPED
from filters.logs.findings import header_of
from thruster_env.core.streams import filter_keys
from thruster_env.logs import write
from thruster_env.logs.columns import COUNTERS, DATE_NAMES, LENGTHS, TIME_NAMES, WORDS, conversion, plain
from thruster_env.model.quantities import Quantity

COLUMNS = r"""
/* Part a header into its name and its unit, as in "U_mV", "speed_rad_per_s" and "speed [rad/s]"; "" for none. */
static void part(const char *header, char *base, char *unit)
{
    size_t size = strlen(header), end, begin;
    char last[LONGEST];

    strcpy(base, header);
    unit[0] = '\0';
    if (size > 2 && (header[size - 1] == ']' || header[size - 1] == ')')) {
        begin = size - 1;
        while (begin > 0 && strchr("[]()", header[begin - 1]) == NULL) {
            begin--;
        }
        if (begin > 1 && (header[begin - 1] == '[' || header[begin - 1] == '(')) {
            base[begin - 1] = '\0';
            if (stripped(base)[0] != '\0') {
                memcpy(unit, header + begin, size - 1 - begin);
                unit[size - 1 - begin] = '\0';
                memmove(unit, stripped(unit), strlen(stripped(unit)) + 1);
                end = begin - 1;
                while (end > 0 && is_blank((unsigned char)base[end - 1])) {
                    base[--end] = '\0';
                }
                return;
            }
            strcpy(base, header);
        }
    }
    end = size;
    while (end > 0 && header[end - 1] != '_') {
        end--;
    }
    if (end < 2) { /* nothing before the last "_" */
        return;
    }
    strcpy(last, header + end);
    size = strlen(last);
    char power = size > 1 && (last[size - 1] == '2' || last[size - 1] == '3') ? last[size - 1] : '\0';
    last[power != '\0' ? size - 1 : size] = '\0';
    if (strcmp(last, "s") == 0 || strcmp(last, "min") == 0 || strcmp(last, "h") == 0) {
        size_t over = end - 1;
        int is_per = over > 4 && strncmp(header + over - 4, "_per", 4) == 0;
        over -= is_per ? 4 : 0;
        begin = over;
        while (begin > 0 && is_letter((unsigned char)header[begin - 1])) {
            begin--;
        }
        if (begin > 1 && begin < over && header[begin - 1] == '_') {
            char word[LONGEST];
            memcpy(word, header + begin, over - begin);
            word[over - begin] = '\0';
            if (is_among(word, is_per ? known_units : lengths)) {
                strcpy(unit, word);
                strcat(strcat(unit, "/"), last);
                if (power != '\0') {
                    size = strlen(unit);
                    unit[size] = '^';
                    unit[size + 1] = power;
                    unit[size + 2] = '\0';
                }
                base[begin - 1] = '\0';
                return;
            }
        }
    }
    if (is_among(header + end, known_units)) {
        strcpy(unit, header + end);
        base[end - 1] = '\0';
    }
}

/* Whether a name is another, where blanks and "-" are "_", maybe in any case of letters. */
static int is_named(const char *text, const char *name, int in_any_case)
{
    for (; *text != '\0' && *name != '\0'; text++, name++) {
        int byte = *text == ' ' || *text == '-' ? '_' : *text;
        if ((in_any_case ? lower(byte) : byte) != *name) {
            return 0;
        }
    }
    return *text == *name;
}

/* Take a column for a quantity, or for times, in a unit; "" for its own. */
static int take(int i, int k, const char *unit)
{
    column_of[i] = k;
    factor_of[i] = divisor_of[i] = 1.0;
    zero_of[i] = 0.0;
    if (unit[0] == '\0') {
        return 1;
    }
    for (size_t j = 0; j < sizeof units / sizeof units[0]; j++) {
        if (units[j].of == unit_of[i] && strcmp(units[j].text, unit) == 0) {
            factor_of[i] = units[j].factor;
            divisor_of[i] = units[j].divisor;
            zero_of[i] = units[j].zero;
            return 1;
        }
    }
    fprintf(stderr, "line %ld: the unit of column %s must be one that this program converts, but got '%s'%s\n",
            line_number, titles[k], unit, WAY);
    return 0;
}

/* The column of a header that is given, "HEADER" or "HEADER[UNIT]". */
static int take_given(int i, const char *word)
{
    static char base[LONGEST], unit[LONGEST], own[LONGEST];
    int bare = -1, same = 0;

    for (int k = 0; k < width; k++) {
        if (strcmp(titles[k], word) == 0) {
            part(word, base, unit);
            return take(i, k, strcmp(word, symbols[i]) == 0 || strcmp(word, headers[i]) == 0 ? "" : unit);
        }
    }
    if (strlen(word) < LONGEST) {
        size_t size = strlen(word);
        const char *open = size > 0 && word[size - 1] == ']' ? strrchr(word, '[') : NULL;
        unit[0] = '\0';
        strcpy(own, word);
        if (open != NULL) {
            strcpy(unit, open + 1);
            unit[strlen(unit) - 1] = '\0';
            own[open - word] = '\0';
        }
        memmove(own, stripped(own), strlen(stripped(own)) + 1);
        memmove(unit, stripped(unit), strlen(stripped(unit)) + 1);
        for (int k = 0; k < width; k++) {
            static char name[LONGEST], its[LONGEST];
            part(titles[k], name, its);
            if (strcmp(titles[k], own) == 0) {
                bare = k;
                same = 1;
                break;
            }
            if (strcmp(name, own) == 0) {
                bare = k;
                same++;
            }
        }
    }
    if (same != 1) {
        fprintf(stderr, "a log must have a column %s, or its headers be given\n", word);
        return 0;
    }
    if (unit[0] == '\0') {
        part(titles[bare], base, unit);
    }
    return take(i, bare, unit);
}

/* How a header may name a quantity, in the order in which they are tried. */
enum { BY_NAME, BY_SYMBOL, BY_SYMBOL_AND_UNIT, BY_OWN_HEADER, NAMINGS };

/* Whether a column holds a quantity already. */
static int is_taken(int k)
{
    int i = 0;

    while (i < COLUMNS && column_of[i] != k) {
        i++;
    }
    return i < COLUMNS;
}

/* The first free column that names a quantity; names of all quantities come before symbols. */
static int take_named(int naming, int i)
{
    static char base[LONGEST], unit[LONGEST];

    for (int k = 0; k < width; k++) {
        part(titles[k], base, unit);
        const int names_it[NAMINGS] = {
            names[i][0] != '\0' && is_named(base, names[i], 1), is_named(titles[k], symbols[i], 0),
            is_named(base, symbols[i], 0), strcmp(titles[k], headers[i]) == 0};
        if (names_it[naming] && !is_taken(k)) {
            return take(i, k, naming == BY_SYMBOL || naming == BY_OWN_HEADER ? "" : unit);
        }
    }
    return 1;
}

/* The columns of all quantities by their headers. */
static int take_all_named(void)
{
    for (int naming = 0; naming < NAMINGS; naming++) {
        for (int i = 0; i < COLUMNS; i++) {
            if (column_of[i] < 0 && !take_named(naming, i)) {
                return 0;
            }
        }
    }
    for (int i = 0; i < COLUMNS; i++) {
        if (column_of[i] < 0) {
            fprintf(stderr, "a log must have a column %s, or its headers be given\n", headers[i]);
            return 0;
        }
    }
    return 1;
}

/* The column of times, if there is one. */
static int take_time(void)
{
    static char base[LONGEST], unit[LONGEST];

    column_of[TIME] = -1;
    for (int is_date = 0; is_date < 3; is_date++) { /* the last for counters, whose name is the unit */
        for (int k = 0; k < width; k++) {
            part(titles[k], base, unit);
            for (char *letter = base; is_date && *letter != '\0'; letter++) {
                *letter = (char)lower(*letter);
            }
            if (!is_taken(k) && is_among(base, is_date == 2 ? counters : is_date ? date_names : time_names)) {
                if (is_date == 2 && unit[0] == '\0') {
                    strcpy(unit, counter_units[strcmp(base, counters[0]) != 0]);
                }
                is_bare = unit[0] == '\0';
                return take(TIME, k, unit);
            }
        }
    }
    return 1;
}

/* Read the line of headers, and find the columns. */
static int read_headers(char **words)
{
    int counts[3] = {0, 0, 0};

    do {
        if (!read_line()) {
            if (!is_wrong) {
                fprintf(stderr, "a log must have a line of headers\n");
            }
            return 0;
        }
    } while (strspn(line, " \t\v\f\034\035\036\037") == strlen(line));
    for (const char *byte = line; *byte != '\0'; byte++) {
        counts[0] += *byte == ',';
        counts[1] += *byte == ';';
        counts[2] += *byte == '\t';
    }
    delimiter = counts[0] >= counts[1] && counts[0] >= counts[2] ? ',' : counts[1] >= counts[2] ? ';' : '\t';
    if (counts[0] + counts[1] + counts[2] == 0) {
        char *word = stripped(line);
        while (*word != '\0' && !is_blank((unsigned char)*word)) {
            word++;
        }
        if (*word != '\0') { /* spaces part the cells */
            delimiter = ' ';
            word = stripped(line);
            memmove(line, word + (*word == '#'), strlen(word + (*word == '#')) + 1);
        }
    }
    width = cut();
    if (width < 0) {
        return 0;
    }
    memcpy(kept, line, LONGEST);
    for (int k = 0; k < width; k++) {
        titles[k] = kept + (cells[k] - line);
    }
    while (titles[0][0] == '#' || titles[0][0] == '%') {
        titles[0] = stripped(titles[0] + 1);
    }
    for (int k = 0; k < width; k++) {
        for (int j = 0; j < k; j++) {
            if (titles[k][0] != '\0' && strcmp(titles[j], titles[k]) == 0) {
                return refuse("names of columns must differ from one another", titles[k]);
            }
        }
    }
    for (int i = 0; i < COLUMNS; i++) {
        column_of[i] = -1;
    }
    if (words == NULL) {
        return take_all_named() && take_time();
    }
    for (int i = 0; i < COLUMNS; i++) {
        if (!take_given(i, words[i])) {
            return 0;
        }
    }
    return take_time();
}
"""

MAIN = """\
/* Filter a log: a CSV with a row a step on standard input, estimates on standard output.

       @NAME@_log [HEADER ...] < log.csv > estimates.csv

   HEADER names the columns of the inputs, then of the measurements, "HEADER[UNIT]" with another unit; without any
   they are those below, or others of the same name or symbol. An input acts @WHEN@, and is held where its
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
                double number = step < step_of_row@PAST@ ? (double)NAN : numbers[i];
                last[i] = values[i];
                if (i >= INPUTS || !isnan(number)) {
                    values[i] = (@REAL@)number;
                }
            }
            if (step > 0) {
                @NAME@_predict(&filter@LAST@);
            }
@FIRST@@BEGIN@            @NAME@_update(&filter, values + INPUTS);
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
FIRST = """\
            for (int i = 0; step == 0 && i < CHANNELS; i++) {
                values[INPUTS + i] = (@REAL@)NAN; /* the input until then is unknown */
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
        "FIRST": FIRST * model.feeds,
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
        "LAST": (", values" if model.feeds else ", last") * (model.inputs > 0),
        "WHEN": "until its row" if model.feeds else "from its row on",
        "PAST": " && i >= INPUTS" * model.feeds,
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
            _array("counters[]", [*COUNTERS, ""]),
            _array("counter_units[]", COUNTERS.values()),
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
