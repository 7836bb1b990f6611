"""Chains of effects in compiled code: packed parameters of effects that act one after the other.

Effects are called, not inlined: each loops over all copies of a block, and a plant's two kernels share them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from thruster_env.core.compiled import not_inlined
from thruster_env.core.tuples import written_out
from thruster_env.effects.effects import (
    EFFECT_KIND,
    EFFECT_NUMBER,
    EFFECT_PARAMETERS,
    EFFECT_ROWS,
    EFFECT_TARGET,
    Effect,
)


def _dispatch(effects: tuple[type[Effect], ...]) -> Callable:
    """Write out `run(kind, ...)`, which calls the function of one of some effects."""
    arguments = "memory, b, target, rows, number, numbers, at, begin"
    functions: dict[str, Any] = {f"act_{i}": not_inlined(effect.act) for i, effect in enumerate(effects)}
    lines = [line for i, name in enumerate(functions) for line in (f"if kind == {i}:", f"    {name}({arguments})")]
    return written_out("run_effect", f"kind, {arguments}", *lines, "None", **functions)


def chain_of(effects: tuple[type[Effect], ...], count: int) -> Callable:
    """Return `run(memory, b, numbers, at, begin)`: run the effects that `effects.encoded` put at numbers[at].

    It returns the place where they end.

    Args:
        effects: the known types of effects, as `encoded` had them.
        count: the place in numbers where their number stands.
    """
    dispatch = _dispatch(effects)

    @not_inlined
    def run_chain(memory, b, numbers, at, begin):
        for _ in range(int(numbers[count])):
            kind, target = int(numbers[at + EFFECT_KIND]), int(numbers[at + EFFECT_TARGET])
            rows, number = int(numbers[at + EFFECT_ROWS]), int(numbers[at + EFFECT_NUMBER])
            dispatch(kind, memory, b, target, rows, number, numbers, at + EFFECT_PARAMETERS, begin)
            at += int(numbers[at])
        return at

    return run_chain
