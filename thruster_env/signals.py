"""Numbers by which compiled code in several threads tells one another how far it is.

The first says which call is on; each helper has one that says which call it has done. Every one has a cache line
of its own, so that writing one does not slow the reading of another.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from thruster_env.compiled import inlined, overloaded

LINE = 16  # integers of 8 bytes: two cache lines, for processors that fetch pairs
CALL = 0  # place of the current call's number
LOOKS = 64  # at a number between two moments in which another thread may have the core
PATIENCE = 1000  # such moments, of about half a microsecond each


def new_signals(helpers: int) -> np.ndarray:
    """Signals of a caller and some helpers."""
    return np.zeros(LINE * (helpers + 1), np.int64)


@overloaded
def read(signals, place):
    """Read one signal, and with it all that its writer wrote before."""
    return signals[place]


@overloaded
def post(signals, place, value):
    """Write one signal; who reads it sees all that was written before."""
    signals[place] = value


@overloaded
def give_way():
    """Let another thread have the core if one wants it."""


@inlined
def announce(signals, call):
    """Tell the helpers that a call has begun."""
    post(signals, CALL, call)


@inlined
def wait_for_helpers(signals, helpers, call):
    """Wait until all helpers have done a call."""
    for place in range(1, helpers + 1):
        looks = 0
        while read(signals, LINE * place) < call:
            looks += 1
            if looks % LOOKS == 0:
                give_way()


@inlined
def finish(signals, place, call):
    """Tell that a helper has done a call, then look out for the next for a while."""
    post(signals, LINE * place, call)
    for _ in range(PATIENCE):
        for _ in range(LOOKS):
            if read(signals, CALL) > call:
                return
        give_way()


@cache
def teach_numba() -> None:
    """Have numba compile `read`, `post` and `give_way` to what the processor has for it."""
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

    sched_yield = types.ExternalFunction("sched_yield", types.int32())

    @overload(read)
    def read_compiled(signals, place):
        return lambda signals, place: load(signals, place)

    @overload(post)
    def post_compiled(signals, place, value):
        return lambda signals, place, value: store(signals, place, value)

    @overload(give_way)
    def give_way_compiled():
        def compiled_give_way():
            sched_yield()

        return compiled_give_way
