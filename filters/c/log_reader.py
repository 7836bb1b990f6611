"""The part of a program in C that reads a log: the rules of `thruster_env.plants.logs`, or a line's number."""

READER = r"""
static char line[LONGEST], kept[LONGEST], *cells[MOST_CELLS], *titles[MOST_CELLS], time_text[40], delimiter = ',';
static long line_number, empty_line, samples[COLUMNS], samples_of_rows;
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
            return refuse("a line must be text of at most 65535 bytes", byte == 0 ? "a zero byte" : "more");
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
    if (line_number == 1 && strncmp(line, "\357\273\277", 3) == 0) {
        memmove(line, line + 3, (size_t)size - 2);
    }
    return is_utf8(line) || refuse("a line must be text in UTF-8", "other bytes");
}

/* Cut the line into cells, of which some are in quotes; their number, -1 if it is refused. */
static int cut(void)
{
    char *from = line, *to = line;
    int count = 0;

    for (;;) {
        int is_quoted = 0;

        if (count == MOST_CELLS) {
            refuse("a line must have at most 4096 cells", "more");
            return -1;
        }
        while (*from == ' ') {
            from++;
        }
        cells[count++] = to;
        if (*from == '"') {
            for (is_quoted = 1, from++; is_quoted; from++) {
                if (*from == '\0') {
                    refuse("a cell in quotes must end in its line", "none");
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
    fprintf(stderr, "line %ld: the unit of column %s must be one that this program converts, but got '%s'\n",
            line_number, titles[k], unit);
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
    for (int is_date = 0; is_date < 2; is_date++) {
        for (int k = 0; k < width; k++) {
            part(titles[k], base, unit);
            for (char *letter = base; is_date && *letter != '\0'; letter++) {
                *letter = (char)lower(*letter);
            }
            if (!is_taken(k) && is_among(base, is_date ? date_names : time_names)) {
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

/* Whether times are those of a grid: whether there still is a step d with |t_k - t_0 - k d| <= d/20. */
static int is_on_grid(long row, double time)
{
    const double tolerance = 0.05;

    if (row == 0) {
        first_time = time;
        shortest = 0.0;
        longest = HUGE_VAL;
        return 1;
    }
    double since = time - first_time;
    double low = since / ((double)row + tolerance), high = since / ((double)row - tolerance);
    shortest = low > shortest ? low : shortest;
    longest = high < longest ? high : longest;
    return since > 0.0 && shortest <= longest;
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
            return refuse("times must be in seconds, or their column say its unit", cells[column_of[TIME]]);
        }
        if (!is_on_grid(row, numbers[TIME])) {
            return refuse("times must be one step apart, to a twentieth of a step", cells[column_of[TIME]]);
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
