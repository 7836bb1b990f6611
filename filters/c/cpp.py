"""NAME.hpp: a filter in C as a class of C++."""

from __future__ import annotations

from filters.c.programs import FilterPrograms

CLASS = """\
/* The filter {name} as a class of C++11; link with {name}.c, which a compiler of C makes. */
#ifndef {guard}_HPP
#define {guard}_HPP

#include "{name}.h"

class {type} {{
public:
    using Real = {real};

    enum {{ states = {guard}_STATES, inputs = {guard}_INPUTS, measurements = {guard}_MEASUREMENTS }};

    /* Begins with the prior{with_key}. */
    {explicit}{type}({of_key}) noexcept {{ reset({by_key}); }}

    void reset({of_key}) noexcept {{ {name}_init(&filter_{and_key}); }}

    /* Predict a step{under}. */
    void predict({u}) noexcept {{ {name}_predict(&filter_{given}); }}

    /* Correct by a measurement; a channel that is NaN is missing. */
    void update(const Real (&z)[measurements]) noexcept {{ {name}_update(&filter_, z); }}

    Real estimate(int state) const noexcept {{ return filter_.x[state]; }}

    Real covariance(int row, int column) const noexcept {{ return filter_.P[row * states + column]; }}

    /* The innovation, its covariance, NIS, and whatever else {name}.h names. */
    const {name} &told() const noexcept {{ return filter_; }}

{tests}private:
    {name} filter_;
}};

#endif
"""


TESTS = """\
    /* Whether no test has raised an alarm of late; tests that raise one now, a sum of {guard}_STUCK, ... */
    bool healthy() const noexcept {{ return filter_.healthy != 0; }}

    unsigned alarms(int channel) const noexcept {{ return filter_.channel[channel].alarms; }}

    /* Begin the tests anew. */
    void test_anew() noexcept {{ {name}_test_anew(&filter_); }}

"""


def class_of(name: str, programs: FilterPrograms, *, single: bool = False, tested: bool = False) -> str:
    """The header of a class, NameFilter, around the filter in C of this name, which may test its innovations."""
    words = "".join(word.capitalize() for word in name.split("_"))
    inputs, drawn = programs.model.inputs > 0, programs.members > 0
    return CLASS.format(
        name=name,
        guard=name.upper(),
        type=f"{words}Filter",
        real="float" if single else "double",
        under=" under u" * inputs,
        u="const Real (&u)[inputs]" * inputs,
        given=", u" * inputs,
        tests=TESTS.format(name=name, guard=name.upper()) * tested,
        with_key=" and a key: the same one gives the same random numbers" * drawn,
        explicit="explicit " * drawn,
        of_key="uint32_t key_0 = 0, uint32_t key_1 = 0" * drawn,
        by_key="key_0, key_1" * drawn,
        and_key=", key_0, key_1" * drawn,
    )
