"""The tests of `filters.monitoring` in C: `monitor.step_tests`, after each update of a filter."""

from __future__ import annotations

from filters.monitoring import MEANING, TESTS, Monitor
from thruster_env.graphs.programs import literal

LARGEST = {False: 1e100, True: 1e15}  # of normalised innovations, in double and in single precision

ENUM = """\
/* Tests of innovations: a channel's alarms are a sum of these. */
enum {{ {tests} }};

typedef struct {{
    unsigned alarms;          /* tests that raise an alarm at this update */
    unsigned long since[6];   /* of each test, at its last alarm: the update, from 0 on, at which it began */
    {real} size[6];         /* a bias or outlier in the channel's unit, a ratio of variances, or readings */
    {real} sums[2];         /* from here on what the tests remember */
    unsigned long began[2];
    {real} squares;
    {real} last;
    {real} ring[{window}];
    unsigned block, equal, gone;
    int filled, next;
}} {name}_channel;

"""
MEMBERS = """\
    {name}_channel channel[{m}]; /* what tests say of each channel */
    int healthy;            /* no alarm within the last {memory} updates, and no channel stuck or missing */
    unsigned long tested;   /* updates since the tests began */
    unsigned long alarmed;  /* at which one, from 1 on, there was the last alarm; 0 for none */
"""
DECLARED = """\

/* Begin the tests anew, as NAME_init does: best when the filter has settled. */
void {name}_test_anew({name} *filter);
"""
FUNCTIONS = """\
static const {real} largest_chi_square[{m}] = {{{of_outliers}}}; /* of 1, 2, ... channels */

static void sound({name} *filter, int i, int test, unsigned long since, {real} size)
{{
    {name}_channel *channel = &filter->channel[i];

    channel->alarms |= 1u << test;
    channel->since[test] = since;
    channel->size[test] = size;
    filter->alarmed = filter->tested + 1;
}}

/* One channel that was measured: an innovation e with unit variance, its standard deviation, and the reading. */
static void test_channel({name} *filter, int i, {real} e, {real} deviation, {real} reading)
{{
    {name}_channel *channel = &filter->channel[i];
    const unsigned long k = filter->tested;
    {real} sum = {zero}, best = {zero}, bias = {zero};
    int length = 0;

    channel->equal = reading == channel->last && channel->equal > 0 ? channel->equal + 1 : 1;
    channel->last = reading;
    if (channel->equal == {stuck}) {{
        sound(filter, i, STUCK, k + 1 - {stuck}, {stuck});
    }}
    for (int side = 0; side < 2; side++) {{
        if (channel->sums[side] == {zero}) {{
            channel->began[side] = k;
        }}
        channel->sums[side] = channel->sums[side] + (side == 0 ? e : -e) - {reference};
        if (channel->sums[side] < {zero}) {{
            channel->sums[side] = {zero};
        }}
        if (channel->sums[side] >= {cusum}) {{
            const {real} size = channel->sums[side] / ({real})(k - channel->began[side] + 1) + {reference};

            sound(filter, i, CUSUM, channel->began[side], (side == 0 ? size : -size) * deviation);
            channel->sums[side] = {zero};
        }}
    }}
    channel->squares += e * e;
    if (++channel->block == {block}) {{
        if (!({low} <= channel->squares && channel->squares <= {high})) {{
            sound(filter, i, VARIANCE, k + 1 - {block}, channel->squares / {block});
        }}
        channel->squares = {zero};
        channel->block = 0;
    }}
    channel->ring[channel->next] = e;
    channel->filled += channel->filled < {window};
    for (int j = 0; j < channel->filled; j++) {{
        sum += channel->ring[(channel->next + {window} - j) % {window}];
        if (sum * sum / ({real})(j + 1) > best) {{
            best = sum * sum / ({real})(j + 1);
            length = j + 1;
            bias = sum / ({real})(j + 1) * deviation;
        }}
    }}
    channel->next = (channel->next + 1) % {window};
    if (best >= {glr}) {{
        sound(filter, i, GLR, k + 1 - (unsigned long)length, bias);
        channel->filled = 0;
    }}
}}

static void test_update({name} *filter, const {real} *z)
{{
    {real} largest = {zero};
    int worst = 0;

    for (int i = 0; i < {m}; i++) {{
        const {real} deviation = {sqrt}(filter->S[i * {m_plus_1}]);
        const {real} e = filter->innovation[i] / deviation;

        filter->channel[i].alarms = 0;
        if (isnan(z[i])) {{
            if (++filter->channel[i].gone == {missing}) {{
                sound(filter, i, MISSING, filter->tested + 1 - {missing}, {missing});
            }}
            continue;
        }}
        filter->channel[i].gone = 0;
        if ({abs}(e) < {limit}) {{ /* a filter that is lost says nothing of a sensor */
            if ({abs}(e) > largest) {{
                largest = {abs}(e);
                worst = i;
            }}
            test_channel(filter, i, e, deviation, z[i]);
        }}
    }}
    if (largest > {zero} && filter->nis >= largest_chi_square[filter->channels - 1]) {{
        sound(filter, worst, OUTLIER, filter->tested, filter->innovation[worst]);
    }}
    filter->tested++;
    filter->healthy = filter->alarmed == 0 || filter->tested - filter->alarmed >= {memory};
    for (int i = 0; i < {m}; i++) {{
        if (filter->channel[i].equal >= {stuck} || filter->channel[i].gone >= {missing}) {{
            filter->healthy = 0;
        }}
    }}
}}

void {name}_test_anew({name} *filter)
{{
    static const {name}_channel begun = {{0}};

    for (int i = 0; i < {m}; i++) {{
        filter->channel[i] = begun;
    }}
    filter->healthy = 1;
    filter->tested = 0;
    filter->alarmed = 0;
}}

"""
README = """
## Alarms

`{name}_update` ends with tests of the innovations, those of `filters.monitoring` in Python. `filter.healthy` is 1
if there was no alarm within the last {memory} updates and no channel is stuck or missing.
`filter.channel[i].alarms` is a sum of

| | test | what it finds | at |
|--:|---|---|---|
{rows}

Beside it, by the places of tests in this table from 0 on, `since` has the update at which the fault began and
`size` how large it is. The first four tests raise one false alarm in {steps} updates if the model is right. While
the filter settles they raise more: `{name}_test_anew` begins them anew.
"""


class TestsWriter:
    """Writes the parts of a filter's files that test its innovations."""

    def __init__(self, monitor: Monitor, name: str, m: int, single: bool):
        reference, cusum, glr, low, high, block, stuck, missing, *of_outliers = monitor.limits(m).tolist()
        self._monitor, self._name, self._numbers = monitor, name, (cusum, glr, low, high, of_outliers)
        real = {"reference": reference, "cusum": cusum, "glr": glr * glr, "low": low, "high": high, "zero": 0.0}
        real["limit"] = LARGEST[single]
        counts = {"m": m, "m_plus_1": m + 1, "window": monitor.window, "memory": monitor.memory}
        counts |= {"block": block, "stuck": stuck, "missing": missing}
        tests = {test.upper(): f"{name.upper()}_{test.upper()}" for test in TESTS}
        self._words = {key: literal(value, single) for key, value in real.items()} | {
            "name": name,
            "real": "float" if single else "double",
            "sqrt": "sqrt" + "f" * single,
            "abs": "fabs" + "f" * single,
            **{key: str(int(value)) for key, value in counts.items()},
            "of_outliers": ", ".join(literal(limit, single) for limit in of_outliers),
            "tests": ", ".join(f"{test} = {1 << k}" for k, test in enumerate(tests.values())),
        }
        self._places = "enum {{ {} }};\n\n".format(", ".join(test.upper() for test in TESTS))

    @property
    def types(self) -> str:
        """Of NAME.h, before the struct."""
        return ENUM.format(**self._words)

    @property
    def members(self) -> str:
        """Of the struct."""
        return MEMBERS.format(**self._words)

    @property
    def declared(self) -> str:
        """Of NAME.h, after the other functions."""
        return DECLARED.format(**self._words).replace("NAME", self._name)

    @property
    def functions(self) -> str:
        """Of NAME.c."""
        return self._places + FUNCTIONS.format(**self._words)

    @property
    def readme(self) -> str:
        """A section of the README."""
        monitor, (cusum, glr, low, high, of_outliers) = self._monitor, self._numbers
        squares = ", ".join(f"{limit:.4g}" for limit in of_outliers)
        counts = "of 1, 2, ... channels " * (len(of_outliers) > 1)
        at = {
            "outlier": f"v' S^-1 v {counts}of {squares}",
            "cusum": f"a sum of {cusum:.4g} of innovations less {0.5 * monitor.bias:g} standard deviations",
            "glr": f"{glr:.4g} standard deviations of the sum of up to {monitor.window} innovations",
            "variance": f"a sum of {monitor.block} squares below {low:.4g} or above {high:.4g}",
            "stuck": f"{monitor.stuck} in a row",
            "missing": f"{monitor.missing} in a row",
        }
        rows = (
            f"| {1 << k} | `{self._name.upper()}_{test.upper()}` | {MEANING[test]} | {at[test]} |"
            for k, test in enumerate(TESTS)
        )
        words = {"name": self._name, "memory": monitor.memory, "steps": f"{monitor.steps_between:g}"}
        return README.format(rows="\n".join(rows), **words)
