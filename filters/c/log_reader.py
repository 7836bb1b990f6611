"""The part of a program in C that reads lines and rows of a log: the rules of `thruster_env.logs`."""

LINES = r"""
#define WAY "; thruster log LOG --out NEW.csv writes what thruster estimate reads of it"

static char line[LONGEST], kept[LONGEST], *cells[MOST_CELLS], *titles[MOST_CELLS], time_text[40], delimiter = ',';
static long line_number, empty_line, samples[COLUMNS], samples_of_rows, step_of_row, single_steps;
static int width, column_of[COLUMNS + 1], varies[COLUMNS], is_wrong, is_bare;
static double factor_of[COLUMNS + 1], divisor_of[COLUMNS + 1], zero_of[COLUMNS + 1];
static double numbers[COLUMNS + 1], first_values[COLUMNS], first_time, shortest, longest;

/* Say why a line is refused. */
static int refuse(const char *rule, const char *got)
{
    fprintf(stderr, "line %ld: %s, but got '%s'\n", line_number, rule, got);
    is_wrong = 1;
    return 0;
}

/* Say why a line is refused whose log `thruster estimate` may read. */
static int refuse_here(const char *rule, const char *got)
{
    fprintf(stderr, "line %ld: %s, but got '%s'%s\n", line_number, rule, got, WAY);
    is_wrong = 1;
    return 0;
}

static int is_blank(int byte)
{
    return byte == ' ' || (byte >= '\t' && byte <= '\r') || (byte >= 28 && byte <= 31);
}

static int is_letter(int byte)
{
    return (byte >= 'a' && byte <= 'z') || (byte >= 'A' && byte <= 'Z');
}

static int is_digit(int byte)
{
    return byte >= '0' && byte <= '9';
}

static int lower(int byte)
{
    return byte >= 'A' && byte <= 'Z' ? byte + ('a' - 'A') : byte;
}

static int is_among(const char *text, const char *const *some)
{
    for (; (*some)[0] != '\0'; some++) {
        if (strcmp(text, *some) == 0) {
            return 1;
        }
    }
    return 0;
}

/* A text without blanks at its ends. */
static char *stripped(char *text)
{
    size_t size;

    while (is_blank((unsigned char)*text)) {
        text++;
    }
    size = strlen(text);
    while (size > 0 && is_blank((unsigned char)text[size - 1])) {
        text[--size] = '\0';
    }
    return text;
}

/* Whether bytes are UTF-8. */
static int is_utf8(const char *text)
{
    const unsigned char *byte = (const unsigned char *)text;

    while (*byte != 0) {
        int more = *byte < 0x80 ? 0 : *byte >= 0xC2 && *byte < 0xE0 ? 1 : (*byte & 0xF0) == 0xE0 ? 2 : 3;
        int from = *byte == 0xE0 ? 0xA0 : *byte == 0xF0 ? 0x90 : 0x80;
        int to = *byte == 0xED ? 0x9F : *byte == 0xF4 ? 0x8F : 0xBF;
        if (*byte >= 0x80 && (*byte < 0xC2 || *byte > 0xF4)) {
            return 0;
        }
        for (byte++; more > 0; more--, byte++) {
            if (*byte < from || *byte > to) {
                return 0;
            }
            from = 0x80;
            to = 0xBF;
        }
    }
    return 1;
}

/* The next line, without its end; 0 at the end of the log, or if it is refused. */
static int read_line(void)
{
    int size = 0, byte = getchar();

    if (byte == EOF) {
        return 0;
    }
    line_number++;
    for (; byte != EOF && byte != '\n' && byte != '\r'; byte = getchar()) {
        if (byte == 0 || size == LONGEST - 1) {
            line[0] = '\0';
            return byte == 0 ? refuse("a line must be text", "a zero byte")
                             : refuse_here("a line must be text of at most 65535 bytes", "more");
        }
        line[size++] = (char)byte;
    }
    if (byte == '\r') {
        byte = getchar();
        if (byte != '\n' && byte != EOF) {
            ungetc(byte, stdin);
        }
    }
    line[size] = '\0';
    while (line_number == 1 && strncmp(line, "\357\273\277", 3) == 0) {
        memmove(line, line + 3, strlen(line) - 2);
    }
    return is_utf8(line) || refuse("a line must be text in UTF-8", "other bytes");
}

/* Cut the line into cells, of which some are in quotes; their number, -1 if it is refused. */
static int cut(void)
{
    char *from = line, *to = line;
    int count = 0;

    if (delimiter == ' ') {
        for (from = stripped(line); *from != '\0'; count++) {
            if (count == MOST_CELLS) {
                refuse_here("a line must have at most 4096 cells", "more");
                return -1;
            }
            cells[count] = from;
            while (*from != '\0' && !is_blank((unsigned char)*from)) {
                from++;
            }
            while (is_blank((unsigned char)*from)) {
                *from++ = '\0';
            }
        }
        return count;
    }
    for (;;) {
        int is_quoted = 0;

        if (count == MOST_CELLS) {
            refuse_here("a line must have at most 4096 cells", "more");
            return -1;
        }
        while (*from == ' ') {
            from++;
        }
        cells[count++] = to;
        if (*from == '"') {
            for (is_quoted = 1, from++; is_quoted; from++) {
                if (*from == '\0') {
                    refuse_here("a cell in quotes must end in its line", "none");
                    return -1;
                }
                if (*from == '"' && *++from != '"') {
                    break;
                }
                *to++ = *from;
            }
        }
        while (*from != '\0' && *from != delimiter) {
            *to++ = *from++;
        }
        if (*from == '\0') {
            *to = '\0';
            break;
        }
        from++;
        *to++ = '\0';
    }
    for (int k = 0; k < count; k++) {
        cells[k] = stripped(cells[k]);
    }
    return count;
}

/* Whether all cells of a line are empty. */
static int is_empty(int count)
{
    for (int k = 0; k < count; k++) {
        if (cells[k][0] != '\0') {
            return 0;
        }
    }
    return 1;
}
"""
ROWS = r"""
/* A cell as a number, NaN if it is missing; 0 if it is refused. */
static int read_number(int i, double *number)
{
    static const char *const missing[] = {"nan", "na", "n/a", "null", "none", "<na>", "nat", ""};
    const char *cell = cells[column_of[i]], *byte = cell;
    char word[8] = "";
    int digits = 0, more = 0;

    for (size_t k = 0; k < sizeof word - 1 && cell[k] != '\0'; k++) {
        word[k] = (char)lower(cell[k]);
    }
    *number = (double)NAN;
    if (cell[0] == '\0' || (strlen(cell) < sizeof word && is_among(word, missing))) {
        return 1;
    }
    byte += *byte == '+' || *byte == '-';
    for (; is_digit((unsigned char)*byte); byte++) {
        digits++;
    }
    for (byte += *byte == '.'; is_digit((unsigned char)*byte); byte++) {
        digits++;
    }
    if (digits > 0 && (*byte == 'e' || *byte == 'E')) {
        byte++;
        byte += *byte == '+' || *byte == '-';
        for (; is_digit((unsigned char)*byte); byte++) {
            more++;
        }
        digits = more;
    }
    if ((digits == 0 || *byte != '\0') && i == TIME && strlen(cell) > 7 && is_digit((unsigned char)cell[0])) {
        return refuse_here("times must be numbers", cell);
    }
    if (digits == 0 || *byte != '\0') {
        fprintf(stderr, "line %ld: column %s must hold numbers, but got '%s'\n", line_number, titles[column_of[i]],
                cell);
        return 0;
    }
    *number = strtod(cell, NULL);
    *number = zero_of[i] != 0.0 ? (*number * factor_of[i] + zero_of[i]) / divisor_of[i]
                                : *number * (factor_of[i] / divisor_of[i]);
    if (!(fabs(*number) <= (double)LARGEST)) {
        fprintf(stderr, "line %ld: column %s must hold finite numbers, but got '%s'\n", line_number,
                titles[column_of[i]], cell);
        return 0;
    }
    return 1;
}

/* Whether a time is that of a step: of one of STEP seconds, to a twentieth; or, where that is not known, of the
   next one if there still is a step d with |t_k - t_0 - k d| <= d/20. */
static int is_on_grid(long row, double time)
{
    const double tolerance = 0.05, most = 1e7;
    double since = row == 0 ? 0.0 : time - first_time;

    if (row == 0) {
        first_time = time;
        shortest = 0.0;
        longest = HUGE_VAL;
    } else if (STEP > 0.0) {
        double number = floor(since / STEP + 0.5);
        if (!(number > (double)step_of_row && number <= most) || fabs(since - number * STEP) > tolerance * STEP) {
            return 0;
        }
        single_steps += number == (double)step_of_row + 1.0;
        step_of_row = (long)number;
        return 2 * single_steps + 6 >= row; /* else most of them are not one step */
    } else {
        double low = since / ((double)row + tolerance), high = since / ((double)row - tolerance);
        shortest = low > shortest ? low : shortest;
        longest = high < longest ? high : longest;
    }
    return row == 0 || (since > 0.0 && shortest <= longest);
}

/* Print the time of a step, as the log has it where it has its row. */
static void show_time(long step)
{
    if (step == step_of_row || time_text[0] == '\0') {
        printf("%s", time_text);
    } else {
        printf("%.15g", first_time + (double)step * STEP);
    }
}

/* The numbers of the next row, NaN for a missing one; 0 at the end of the log, or if it is refused. */
static int read_row(long row)
{
    int count;

    do {
        if (!read_line()) {
            return 0;
        }
        count = cut();
        if (count < 0) {
            return 0;
        }
        if (is_empty(count) && empty_line == 0) {
            empty_line = line_number;
        }
    } while (is_empty(count));
    is_wrong = 1;
    if (empty_line > 0 && row > 0 && column_of[TIME] < 0) {
        fprintf(stderr, "line %ld is empty: rows of a log without times must follow one another\n", empty_line);
        return 0;
    }
    empty_line = 0;
    if (count != width) {
        return refuse("a row must have as many cells as the header", count < width ? "fewer" : "more");
    }
    time_text[0] = '\0';
    if (column_of[TIME] >= 0) {
        if (!read_number(TIME, &numbers[TIME])) {
            return 0;
        }
        if (isnan(numbers[TIME])) {
            return refuse("every row must have a time", "");
        }
        double since = row > 0 ? numbers[TIME] - first_time : 0.0;
        if (is_bare && (fabs(numbers[TIME]) > 4.1e9 || (row > 0 && since >= 100.0 * (double)row) ||
                        (since > 0.0 && fabs(numbers[TIME]) > 2e4 && since < 2e-5 * (double)row))) {
            return refuse_here("times must be in seconds, or their column say its unit", cells[column_of[TIME]]);
        }
        if (!is_on_grid(row, numbers[TIME])) {
            return refuse_here(STEP > 0.0 ? "times must be steps of " STEP_TEXT " s, to a twentieth of a step, "
                                            "and most of them one step apart"
                                          : "times must be one step apart, to a twentieth of a step",
                               cells[column_of[TIME]]);
        }
        if (factor_of[TIME] == divisor_of[TIME] && strlen(cells[column_of[TIME]]) < sizeof time_text) {
            strcpy(time_text, cells[column_of[TIME]]);
        } else {
            snprintf(time_text, sizeof time_text, "%.15g", numbers[TIME]);
        }
    }
    for (int i = 0; i < COLUMNS; i++) {
        if (!read_number(i, &numbers[i])) {
            return 0;
        }
        if (isnan(numbers[i])) {
            if (i < INPUTS && row == 0) {
                return refuse("an input must be known from the first row on", headers[i]);
            }
            continue;
        }
        varies[i] = varies[i] || (samples[i] > 0 && numbers[i] != first_values[i]);
        first_values[i] = samples[i] == 0 ? numbers[i] : first_values[i];
        samples[i]++;
    }
    step_of_row = STEP > 0.0 && column_of[TIME] >= 0 ? step_of_row : row;
    samples_of_rows = row + 1;
    is_wrong = 0;
    return 1;
}

/* Whether the log was one to its end. */
static int is_sound(void)
{
    if (is_wrong) {
        return 0;
    }
    if (samples_of_rows < FEWEST_ROWS) {
        fprintf(stderr, "a log must have at least %d rows, but got %ld\n", (int)FEWEST_ROWS, samples_of_rows);
        return 0;
    }
    if (STEP > 0.0 && column_of[TIME] >= 0 && 2 * single_steps < samples_of_rows - 1) {
        fprintf(stderr, "most rows must be one step of " STEP_TEXT " s apart, but got %ld of %ld%s\n",
                single_steps, samples_of_rows - 1, WAY);
        return 0;
    }
    for (int i = INPUTS; i < COLUMNS; i++) {
        if (samples[i] == 0 || (samples[i] > 1 && !varies[i])) {
            fprintf(stderr, "a measurement must %s, but column %s does not\n",
                    samples[i] == 0 ? "have numbers" : "vary", titles[column_of[i]]);
            return 0;
        }
    }
    return 1;
}
"""
