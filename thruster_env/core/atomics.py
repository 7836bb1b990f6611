"""Atomic flags with which compiled code synchronises several threads.

One integer holds the number of the current call. For each part of a call that a worker thread may do, another one
says whether the part is open, taken or done. Every flag has a cache line of its own, so that writing one does not
slow down the reading of another.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from thruster_env.core.compiled import inlined, overloaded

LINE = 16  # integers of 8 bytes: two cache lines, for processors that fetch pairs
CALL = 0  # place of the current call's number
OPEN, TAKEN, DONE = 0, 1, 2  # what a part of a call may be
SPINS = 64  # at a number between two moments in which another thread may have the core
SPIN_ROUNDS = 1000  # such moments in a wait for the next call, of about half a microsecond each


def new_flags(places: int) -> np.ndarray:
    """Zeros, a line for each of some places."""
    return np.zeros(LINE * places, np.int64)


@overloaded
def read(flags, place):
    """Read one flag (acquire): whatever its writer wrote before is then visible."""
    return flags[place]


@overloaded
def post(flags, place, value):
    """Write one flag (release): whoever reads it sees all that was written before."""
    flags[place] = value


@overloaded
def take(marks, place, mark):
    """Mark a part if it is open (compare and swap); return whether it was open."""
    was_open = marks[place] == OPEN
    if was_open:
        marks[place] = mark
    return was_open


@overloaded
def yield_core():
    """Let another thread have the core if one wants it."""


@inlined
def wait_for(marks, place):
    """Wait until a part that another thread has taken is done."""
    spins = 0
    while read(marks, place) != DONE:
        spins += 1
        if spins % SPINS == 0:
            yield_core()


@inlined
def spin_for_call(flags, call, rounds):
    """Wait for the next call for a limited time, of some rounds (spin-wait)."""
    for _ in range(rounds):
        for _ in range(SPINS):
            if read(flags, CALL) > call:
                return
        yield_core()


@cache
def teach_numba() -> None:
    """Have numba compile `read`, `post`, `take` and `yield_core` to what the processor has for it."""
    from numba import extending, types
    from numba.extending import overload

    intrinsic: Callable = extending.intrinsic  # numba passes the context, of which its annotations do not know

    @intrinsic
    def load(context, flags, place):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            return builder.load_atomic(builder.gep(array.data, [arguments[1]]), "acquire", 8)

        return types.int64(flags, types.intp), generate

    @intrinsic
    def store(context, flags, place, value):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            builder.store_atomic(arguments[2], builder.gep(array.data, [arguments[1]]), "release", 8)
            return context.get_dummy_value()

        return types.void(flags, types.intp, types.int64), generate

    @intrinsic
    def exchange(context, marks, place, mark):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            where, before = builder.gep(array.data, [arguments[1]]), context.get_constant(types.int64, OPEN)
            return builder.extract_value(builder.cmpxchg(where, before, arguments[2], "acq_rel", "acquire"), 1)

        return types.boolean(marks, types.intp, types.int64), generate

    sched_yield = types.ExternalFunction("sched_yield", types.int32())

    @overload(read)
    def read_compiled(flags, place):
        return lambda flags, place: load(flags, place)

    @overload(post)
    def post_compiled(flags, place, value):
        return lambda flags, place, value: store(flags, place, value)

    @overload(take)
    def take_compiled(marks, place, mark):
        return lambda marks, place, mark: exchange(marks, place, mark)

    @overload(yield_core)
    def yield_core_compiled():
        def compiled_yield_core():
            sched_yield()

        return compiled_yield_core
