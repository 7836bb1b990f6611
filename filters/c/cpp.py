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

    /* Begins with the prior. */
    {type}() noexcept {{ reset(); }}

    void reset() noexcept {{ {name}_init(&filter_); }}

    /* Predict a step{under}. */
    void predict({u}) noexcept {{ {name}_predict(&filter_{given}); }}

    /* Correct by a measurement; a channel that is NaN is missing. */
    void update(const Real (&z)[measurements]) noexcept {{ {name}_update(&filter_, z); }}

    Real estimate(int state) const noexcept {{ return filter_.x[state]; }}

    Real covariance(int row, int column) const noexcept {{ return filter_.P[row * states + column]; }}

    /* The innovation, its covariance, NIS, and whatever else {name}.h names. */
    const {name} &told() const noexcept {{ return filter_; }}

private:
    {name} filter_;
}};

#endif
"""


def class_of(name: str, programs: FilterPrograms, *, single: bool = False) -> str:
    """The header of a class, NameFilter, around the filter in C of this name."""
    words = "".join(word.capitalize() for word in name.split("_"))
    inputs = programs.model.inputs > 0
    return CLASS.format(
        name=name,
        guard=name.upper(),
        type=f"{words}Filter",
        real="float" if single else "double",
        under=" under u" * inputs,
        u="const Real (&u)[inputs]" * inputs,
        given=", u" * inputs,
    )
