"""Numbers by which compiled code in several threads tells one another how far it is.

One number, for all calls, says which call is on. Each call has for each part that a helper may do a number that
says whether anybody has taken it, and whether it is done. Every number has a cache line of its own, so that
writing one does not slow the reading of another.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from numerics.compiled import inlined, overloaded

LINE = 16  # integers of 8 bytes: two cache lines, for processors that fetch pairs
CALL = 0  # place of the current call's number
OPEN, TAKEN, DONE = 0, 1, 2  # what a part of a call may be
LOOKS = 64  # at a number between two moments in which another thread may have the core
PATIENCE = 1000  # such moments, of about half a microsecond each


def new_signals(places: int) -> np.ndarray:
    """Zeros, a line for each of some places."""
    return np.zeros(LINE * places, np.int64)


@overloaded
def read(signals, place):
    """Read one signal, and with it all that its writer wrote before."""
    return signals[place]


@overloaded
def post(signals, place, value):
    """Write one signal; who reads it sees all that was written before."""
    signals[place] = value


@overloaded
def take(marks, place, mark):
    """Put a mark on a part that is open; return whether it was."""
    was_open = marks[place] == OPEN
    if was_open:
        marks[place] = mark
    return was_open


@overloaded
def give_way():
    """Let another thread have the core if one wants it."""


@inlined
def wait_for(marks, place):
    """Wait until a part that another thread has taken is done."""
    looks = 0
    while read(marks, place) != DONE:
        looks += 1
        if looks % LOOKS == 0:
            give_way()


@inlined
def look_out(signals, call):
    """Look out for a call after this one for a while."""
    for _ in range(PATIENCE):
        for _ in range(LOOKS):
            if read(signals, CALL) > call:
                return
        give_way()


@cache
def teach_numba() -> None:
    """Have numba compile `read`, `post`, `take` and `give_way` to what the processor has for it."""
    from numba import types
    from numba.extending import intrinsic, overload

    @intrinsic
    def load(context, signals, place):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            return builder.load_atomic(builder.gep(array.data, [arguments[1]]), "acquire", 8)

        return types.int64(signals, types.intp), generate

    @intrinsic
    def store(context, signals, place, value):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            builder.store_atomic(arguments[2], builder.gep(array.data, [arguments[1]]), "release", 8)
            return context.get_dummy_value()

        return types.void(signals, types.intp, types.int64), generate

    @intrinsic
    def exchange(context, marks, place, mark):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            where, before = builder.gep(array.data, [arguments[1]]), context.get_constant(types.int64, OPEN)
            return builder.extract_value(builder.cmpxchg(where, before, arguments[2], "acq_rel", "acquire"), 1)

        return types.boolean(marks, types.intp, types.int64), generate

    sched_yield = types.ExternalFunction("sched_yield", types.int32())

    @overload(read)
    def read_compiled(signals, place):
        return lambda signals, place: load(signals, place)

    @overload(post)
    def post_compiled(signals, place, value):
        return lambda signals, place, value: store(signals, place, value)

    @overload(take)
    def take_compiled(marks, place, mark):
        return lambda marks, place, mark: exchange(marks, place, mark)

    @overload(give_way)
    def give_way_compiled():
        def compiled_give_way():
            sched_yield()

        return compiled_give_way
