"""The part of a program in C that finds the columns of a log by their headers, and their units."""

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
