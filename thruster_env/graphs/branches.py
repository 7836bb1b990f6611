"""A function that decides, of numbers that are not known yet: called once for each outcome of its decisions.

    if x[0] > 0.0:                    y = where(x[0] > 0.0, math.sqrt(x[0]), 0.0)
        y = math.sqrt(x[0])
    else:
        y = 0.0

A condition asks its graph, which answers yes at first. Then the function is called again with the last answer
turned round, and so on, and between the results there is a choice. A loop that decides how long it goes on has no
end here; it raises TypeError, as what has too many outcomes does. Where a function itself raises an exception, as
`assert` does, the result is NaN, as that of arithmetic is in machine code where Python raises.
"""

from __future__ import annotations

import dis
from collections.abc import Callable

import numpy as np

from thruster_env.graphs.graphs import Graph, Number, where

MOST_OUTCOMES = 64  # calls of a function
MOST_DECISIONS = 64  # in one call


def on_every_side(function: Callable[[], np.ndarray], graph: Graph) -> np.ndarray:
    """What a function of no arguments makes of numbers of a graph, an array (...) of objects, on all its branches.

    Raises:
        TypeError: if it decides too often, or its results have different shapes.
    """
    calls, failure = 0, None

    def outcome(known: dict[int, bool]) -> np.ndarray | None:
        nonlocal calls, failure
        calls += 1
        if calls > MOST_OUTCOMES:
            raise TypeError(f"a function must have at most {MOST_OUTCOMES} outcomes of its decisions")
        asked: list[Number] = []
        answers = dict(known)

        def decide(number: Number) -> bool:
            if number.value is not None:
                return number.value != 0.0
            condition = number if number.is_condition else number != 0.0
            if condition.place not in answers:
                if len(answers) >= MOST_DECISIONS:
                    raise TypeError(f"a function must decide at most {MOST_DECISIONS} times")
                answers[condition.place] = True
                asked.append(condition)
            return answers[condition.place]

        graph.decide = decide
        found: np.ndarray | None = None
        try:
            found = function()
        except Exception as error:
            if not answers or not _is_raised_there(error):
                raise
            failure = error
        for k, condition in reversed([*enumerate(asked)]):
            before = {one.place: True for one in asked[:k]}
            other = outcome(known | before | {condition.place: False})
            if found is None or other is None:
                known_one = found if other is None else other
                if known_one is None:
                    continue
                found, other = (np.full_like(known_one, np.nan) if one is None else one for one in (found, other))
            if other.shape != found.shape:
                raise TypeError(f"branches must have results of one shape, but got {found.shape}, {other.shape}")
            pairs = zip(found.ravel(), other.ravel(), strict=True)
            chosen = [where(condition, a, b) for a, b in pairs]
            found = np.array([*chosen, None], dtype=object)[:-1].reshape(found.shape)
        return found

    before, graph.decide = graph.decide, None
    try:
        found = outcome({})
    finally:
        graph.decide = before
    if found is None:
        raise failure or TypeError("a function must have a result")
    return found


def _is_raised_there(error: Exception) -> bool:
    """Whether a statement of a traced function itself raised an exception, not something that it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None or trace.tb_frame.f_globals.get("__name__") != "builtins":  # that of copies
        return False
    return trace.tb_frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]
