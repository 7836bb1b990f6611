"""Parameters of a filter in words, each with its unit."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import floor, isfinite, log10

from tuning.problems.problem import Problem
from tuning.search.parameters import index_pairs
from tuning.search.space import Choice, everything_of, neutral, parameters, parameters_of

SMALL, LARGE = 1e-3, 1e5  # what is smaller or larger is told in a unit with a power of ten
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MOST_CORRELATIONS = 3  # of three states or channels: more are one row with the largest
ALIKE = 4  # so many numbers of one kind and more, which are the same in every column, share a row


def typeset(text: str) -> str:
    """Units in a text as pages have them: m^3/s is m³/s."""
    return re.sub(r"(?<=[A-Za-z)])\^(-?\d+)", lambda match: match[1].translate(RAISED), text)


def power_of_ten(values: Iterable[float]) -> int:
    """The exponent, of three or a multiple, that some numbers in one column share; 0 where they need none."""
    sizes = [abs(value) for value in values if isfinite(value) and value]
    largest = max(sizes, default=1.0)
    return 0 if SMALL <= largest < LARGE else 3 * floor(log10(largest) / 3)


def scaled_unit(unit: str, power: int) -> str:
    """A unit with a power of ten before it: "10⁻⁶ m"."""
    factor = f"10{str(power).translate(RAISED)}" if power else ""
    return " ".join(filter(None, (factor, unit)))


def labels(names: Iterable[str], kind: str, problem: Problem, square: str = "^2") -> dict[str, str]:
    """The labels of a filter's parameters in tables: Q11 of the thruster is "Q11 [(rad/s)^2]".

    Args:
        names: of trial parameters.
        kind: name of the filter.
        problem: whose parameters have the units.
        square: what stands for "squared".
    """
    known = parameters(kind, problem, **everything_of(problem))
    units = {parameter.name: parameter.unit.replace("^2", square) for parameter in known}
    wordings = {name: index_pairs(name.replace("_", " ")) for name in names}
    return {name: f"{words} [{units[name]}]" if units.get(name) else words for name, words in wordings.items()}


def number_rows(
    choices: Sequence[Choice], kind: str, problem: Problem, word: Callable, square: str = "^2"
) -> list[list[str]]:
    """Rows of a table of choices' numbers, a column each: a label, and what `word` makes of each number or None.

    Q11, Q22, ... and such that are the same in every column share a row.

    Args:
        choices: of one kind of filter.
        kind: its name.
        problem: whose parameters have the units.
        word: of a number, or of None where a choice does not say it.
        square: what stands for "squared".
    """
    columns = [parameters_of(choice) for choice in choices]
    names = labels(dict.fromkeys(name for column in columns for name in column), kind, problem, square)
    rows = []
    for letter in ("", "R "):
        correlations = [name for name in names if name.startswith(f"{letter}correlation ".replace(" ", "_"))]
        if len(correlations) > MOST_CORRELATIONS:
            values = [[_said(column, name) for name in correlations] for column in columns]
            largest = [
                max((value for value in column if value is not None), key=abs, default=None) for column in values
            ]
            rows.append([f"largest of {len(correlations)} {letter or 'Q '}correlations", *map(word, largest)])
            names = {name: label for name, label in names.items() if name not in correlations}
    rows = [[label, *(word(_said(column, name)) for column in columns)] for name, label in names.items()] + rows
    groups: list[list[list[str]]] = []
    for row in rows:
        alike = groups and row[1:] == groups[-1][0][1:] and _letters(row[0]) == _letters(groups[-1][0][0])
        groups[-1].append(row) if alike else groups.append([row])
    return [row for group in groups for row in ([_shared(group)] if len(group) >= ALIKE else group)]


def _said(column: Mapping[str, float], name: str) -> float | None:
    """A number of a choice; where it has none of Q or R, neither has it correlations of these."""
    letter = "R" if name.startswith("R") else "Q"
    tells = "correlation_" not in name or any(re.fullmatch(rf"{letter}\d+", known) for known in column)
    return column.get(name, neutral(name) if tells else None)


def _letters(label: str) -> str | None:
    """What the label of a variance or a correlation begins with and ends with; the whole of all others."""
    match = re.fullmatch(r"(Q|R|correlation |R correlation )\d+(?:[ ,]\d+)?( \[.*\])?", label)
    return f"{match[1]}{match[2]}" if match else label


def _shared(group: Sequence[Sequence[str]]) -> list[str]:
    """One row for several: "Q11 to Q44 [m^2]"."""
    (first, *cells), last = group[0], group[-1][0]
    return [f"{first.partition(' [')[0]} to {last}", *cells]


def apart(*values: float) -> list[str]:
    """Numbers with four significant digits, or enough to distinguish those that differ by more than rounding."""
    for digits in range(4, 9):
        texts = [f"{value:.{digits}g}" for value in values]
        if len(set(texts)) == len({float(f"{value:.8g}") for value in values}):
            break
    return texts
