"""Options of an identification from the command line: ranges, starts and names."""

from __future__ import annotations

from collections.abc import Mapping

from thruster_env.core.checks import finite, short_repr


def ranges_of(given: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Ranges from texts LOW:HIGH; ValueError for another form."""
    found = {}
    for name, text in given.items():
        low, colon, high = text.partition(":")
        if not colon:
            raise ValueError(f"--range must have the form NAME=LOW:HIGH, but got {short_repr(f'{name}={text}')}")
        found[name] = finite(f"low of {name}", low), finite(f"high of {name}", high)
    return found


def numbers_of(option: str, given: Mapping[str, str]) -> dict[str, float]:
    """Numbers by name."""
    return {name: finite(f"{option} {name}", text) for name, text in given.items()}


def names_of(text: str | None) -> list[str]:
    """Names from a text separated by commas."""
    return [name.strip() for name in (text or "").split(",") if name.strip()]
