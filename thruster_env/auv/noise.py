"""Gaussian noise on rows of a plant's memory, for a plant of any size."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from thruster_env.core.compiled import inlined
from thruster_env.core.memory import KEY_0, KEY_1, STEP
from thruster_env.core.streams import normal_block
from thruster_env.core.tuples import written_out

BLOCK = 4  # normals of one draw


@cache
def noise_adder(size: int, first: int, root: int, stream: int) -> Callable:
    """Return `add(memory, b, numbers)`: add w ~ N(0, L L') to rows first ... first + size - 1 of every copy.

    The draws are those of `thruster_env.model.simulate` with the same keys. For initial states the row STEP must
    be 0.

    Args:
        size: number of rows.
        first: the first of them.
        root: the place of the lower triangular L (size, size) in numbers, by rows.
        stream: the purpose of the noise, from `thruster_env.core.streams`.
    """
    of_copy = "memory[b, KEY_0, j], memory[b, KEY_1, j]"
    lines = ["for j in range(memory.shape[2]):"]
    for block in range(-(-size // BLOCK)):
        draws = ", ".join(f"w{BLOCK * block + i}" for i in range(BLOCK))
        lines.append(f"    {draws} = normal_block({block}, memory[b, STEP, j], {stream}, {of_copy})")
    for i in range(size):
        terms = " + ".join(f"numbers[{root + i * size + k}] * w{k}" for k in range(i + 1))
        lines.append(f"    memory[b, {first + i}, j] += {terms}")
    names: dict[str, Any] = {"normal_block": normal_block, "KEY_0": KEY_0, "KEY_1": KEY_1, "STEP": STEP}
    return written_out("add", "memory, b, numbers", *lines, "None", **names)


@inlined
def add_noise(memory, b, numbers, size, first, root, stream, scratch):
    """Add w ~ N(0, L L') to rows of every copy, as `noise_adder` does, for a number of rows known at run time.

    Zeros in L cost nothing. The draws are written into the rows from `scratch` on, `size` rounded up to a multiple
    of BLOCK.
    """
    for block in range((size + BLOCK - 1) // BLOCK):
        at = scratch + BLOCK * block
        for j in range(memory.shape[2]):
            w = normal_block(block, memory[b, STEP, j], stream, memory[b, KEY_0, j], memory[b, KEY_1, j])
            memory[b, at, j], memory[b, at + 1, j], memory[b, at + 2, j], memory[b, at + 3, j] = w
    for i in range(size):
        for k in range(i + 1):
            factor = numbers[root + i * size + k]
            if factor != 0.0:
                for j in range(memory.shape[2]):
                    memory[b, first + i, j] += factor * memory[b, scratch + k, j]
