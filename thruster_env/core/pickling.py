"""Generated functions remember what made them, so that models that hold them can be pickled."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps

from thruster_env.core.equal_functions import first_equal, original_of
from thruster_env.core.recipes import Made, as_function, as_made, remember
from thruster_env.core.written import made_here

__all__ = ["Made", "as_function", "as_made", "makes_functions"]

MOST = 128  # results that are kept for a maker, beyond those that something else holds


def makes_functions(maker: Callable) -> Callable:
    """Decorate what returns a function, or a tuple or dictionary of functions.

    Of equal arguments there is one result, as with `functools.cache`; of functions among them that are equal
    (`first_equal`), too. What was returned long ago and nobody holds is forgotten.
    """

    @lru_cache(maxsize=MOST)
    def of_first(*arguments):
        result = maker(*arguments)
        if isinstance(result, dict):
            entries = result
        else:
            entries = dict(enumerate(result)) if isinstance(result, tuple) else {None: result}
        for key, function in entries.items():
            nested = "<locals>" in getattr(function, "__qualname__", "")  # others are found by their names
            if made_here(function) or (nested and all(function is not one for one in arguments)):
                remember(function, Made(make, tuple(map(original_of, arguments)), key))
        if isinstance(result, dict):
            return {key: first_equal(function) for key, function in result.items()}
        return first_equal(result)

    @wraps(maker)
    def make(*arguments):
        return of_first(*map(first_equal, arguments))

    make.cache_clear = of_first.cache_clear  # type: ignore[attr-defined]
    return make
