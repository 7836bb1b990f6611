"""Arguments that are defined once: a function takes the arguments of other functions, names and defaults."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from functools import wraps
from typing import Any

Function = Callable[..., Any]


def takes_arguments_of(
    *definitions: Function, leaving_out: Collection[str] = (), defaults: Mapping[str, Any] | None = None
) -> Callable[[Function], Function]:
    """Return a decorator: a function of (self, **arguments) takes those of other functions, names and defaults.

    It is called with all of them, and `inspect.signature` and `help` show them. A method's
    first argument may be given by position, the others by name; its own named arguments come last.

    Args:
        definitions: the functions that define the arguments; each argument in only one of them.
        leaving_out: excluded names.
        defaults: other defaults, by name.
    """
    changed = {} if defaults is None else defaults

    def decorate(function: Function) -> Function:
        own = inspect.signature(function).parameters.values()
        positional = [parameter for parameter in own if parameter.kind is parameter.POSITIONAL_OR_KEYWORD]
        taken = [
            parameter.replace(kind=parameter.KEYWORD_ONLY, default=changed.get(parameter.name, parameter.default))
            for definition in definitions
            for parameter in inspect.signature(definition).parameters.values()
            if parameter.name not in leaving_out
        ]
        if [parameter.name for parameter in positional] == ["self"]:
            taken[0] = taken[0].replace(kind=inspect.Parameter.POSITIONAL_OR_KEYWORD)
        by_name = [parameter for parameter in own if parameter.kind is parameter.KEYWORD_ONLY]
        signature = inspect.Signature([*positional, *taken, *by_name])

        @wraps(function)
        def call(*given, **named):
            try:
                bound = signature.bind(*given, **named)
            except TypeError as error:
                raise TypeError(f"{function.__qualname__}() {error}") from None
            bound.apply_defaults()
            return function(**bound.arguments)

        decorated: Any = call
        decorated.__signature__ = signature
        return decorated

    return decorate


def arguments_of(definition: Function, given: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments by name that a function accepts."""
    known = inspect.signature(definition).parameters
    return {name: value for name, value in given.items() if name in known}
