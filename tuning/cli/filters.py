"""`thruster filters` and `methods`: the available filters with their parameters, and the methods of tuning."""

from __future__ import annotations

import dataclasses
import re
import textwrap
from inspect import cleandoc, getdoc
from itertools import groupby
from typing import Annotated, Any, NamedTuple

from rich.console import RenderableType
from rich.text import Text

from filters.engine.compile import new_memory
from filters.ensembles.stochastic import EnsembleKalmanFilter
from filters.filter import Filter
from filters.registry import FILTERS, filter_type
from thruster_env.core.text_tables import Table, console
from tuning.api.markers import INPUT, Argument, Option
from tuning.api.result import Printed
from tuning.methods.task import GRADIENT, METHODS, TRUTH, find_method
from tuning.problems.find import find_problem
from tuning.problems.problem import Problem
from tuning.search.parameters import GAUSSIANS, KALMAN_SIZES, PARTICLE_SIZES
from tuning.search.space import untuned_choice


class Fit(NamedTuple):
    """Whether a filter fits a problem's model."""

    name: str
    reason: str  # why it does not; empty if it does
    ensemble_size: int | None = None  # of the rule of thumb; None without an ensemble
    kilobytes: float | None = None  # that a belief keeps from step to step, with its scratch


def fits_of(problem: Problem, names: tuple[str, ...] = tuple(FILTERS)) -> list[Fit]:
    """Each filter with the rule of thumb's parameters on a problem's model; nothing is compiled."""
    fits = []
    for name in names:
        try:
            filter_ = untuned_choice(name, problem).filter(problem)
            memory = new_memory(filter_.kernels(), filter_.size)
        except ValueError as error:
            fits.append(Fit(name, str(error)))
            continue
        kilobytes = sum(part.nbytes for part in memory) / 1e3
        fits.append(Fit(name, "", filter_.size or None, kilobytes))
    return fits


def fit_table(problem: Problem, fits: list[Fit]) -> list[RenderableType]:
    """The table of `fits_of`."""
    model = problem.model()
    rows = []
    for fit in fits:
        members = "" if fit.ensemble_size is None else str(fit.ensemble_size)
        rows.append([fit.name, _yes(not fit.reason), members, _size(fit.kilobytes), fit.reason])
    counts = (model.n, "state"), (model.m, "measurement"), (model.inputs, "input")
    sizes = ", ".join(f"{count} {what}{'s' * (count != 1)}" for count, what in counts)
    title = f"Filters on {problem.name}: {sizes}"
    return [
        Table(title, ["filter", "fits", "N", "kB", "why not"], rows, words=True),
        "N: members or particles in the rule of thumb. kB: memory of one belief.",
    ]


def _size(kilobytes: float | None) -> str:
    if kilobytes is None:
        return ""
    return f"{kilobytes:.0f}" if kilobytes >= 100 else f"{kilobytes:.3g}"


MADE = EnsembleKalmanFilter.ensemble_size  # by default
ATTRIBUTES, ERRORS = "Attributes:", "Raises:"  # what these sections of a docstring begin with
OWNERS_WIDTH = 27  # of the longest number, so that the names of filters take no room from what it means


class Number(NamedTuple):
    """A parameter of a filter."""

    name: str
    default: Any
    meaning: str


class Entry(NamedTuple):
    """The description of a filter."""

    name: str
    about: str
    covariance: bool  # whether it says how far it may be off
    ensemble: bool
    numbers: tuple[Number, ...]
    documentation: str


def command(
    name: Annotated[str | None, Argument(INPUT, choices=FILTERS)] = None,
    problem: Annotated[str | None, Option(INPUT, ("--problem", "--scenario"), choices="problems")] = None,
) -> Printed:
    """List the filters and their parameters; or show one filter with its equations and sources.

    Other commands take these names for --filter; so do EstimateState and make_filter.

    Example: thruster filters ukf

    Example: thruster filters --problem my_module:problem

    Args:
        name: a filter to show in full.
        problem: show which filters fit the model of a problem:
    """
    if name is not None:
        filter_type(name)
    if problem is not None:
        chosen = find_problem(problem)
        fits = fits_of(chosen, tuple(FILTERS) if name is None else (name,))
        return Printed(
            fit_table(chosen, fits), {"problem": chosen.name, "filters": [fit._asdict() for fit in fits]}
        )
    entries = [entry(known) for known in FILTERS if name in (None, known)]
    output = overview(entries) if name is None else in_full(entries[0], console.width)
    return Printed(output, {"filters": [_plain(listed) for listed in entries]})


def entry(name: str) -> Entry:
    """The description in a filter's class."""
    kind = filter_type(name)
    filter_class = kind.filter_class
    text, meaning = cleandoc(filter_class.__doc__ or ""), _meanings(filter_class)
    defaults = {field.name: field.default for field in dataclasses.fields(filter_class)}
    numbers = tuple(Number(number, defaults[number], meaning[number]) for number in kind.numbers)
    return Entry(name, first_sentence(text), kind.has_covariance, kind.has_ensemble, numbers, text)


def overview(entries: list[Entry]) -> list[RenderableType]:
    """All filters in one table and all their parameters in another, each shared one once."""
    filters = [[entry.name, entry.about, _yes(entry.covariance), _yes(entry.ensemble)] for entry in entries]
    owners: dict[Number, list[str]] = {}
    for entry in entries:
        for number in entry.numbers:
            owners.setdefault(number, []).append(entry.name)
    numbers = []
    for names, group in groupby(owners, owners.__getitem__):
        numbers.append([Text(textwrap.fill(", ".join(names), OWNERS_WIDTH), style="bold"), "", ""])
        numbers += [[f"  {number.name}", number.default, first_sentence(number.meaning)] for number in group]
    return [
        Table("Filters", ["filter", "what it is", "cov.", "ens."], filters, words=True),
        Table("Parameters of the filters themselves", ["of; number", "default", "meaning"], numbers, words=True),
        "cov.: it has a covariance, the uncertainty of the estimate. ens.: it has an ensemble.",
        f"ensemble_size: {MADE} members in make_filter and estimate, {KALMAN_SIZES.untuned} in the rule of thumb, "
        f"from which tune, evaluate and compare start (particles: {PARTICLE_SIZES.untuned} in both, "
        f"{GAUSSIANS.untuned} of rbpf); a tuned file has its own.",
        "thruster filters NAME shows one in full, with its equations and sources.",
    ]


def in_full(entry: Entry, width: int) -> list[RenderableType]:
    """One filter: its documentation, fitted to a width, and a table of its parameters."""
    kind = filter_type(entry.name).filter_class
    has = f"covariance: {_yes(entry.covariance)}, ensemble: {_yes(entry.ensemble)}"
    output: list[RenderableType] = [Text(entry.name, style="bold"), f"{kind.__module__}.{kind.__name__}", has, ""]
    output.append(fitted(entry.documentation, width))
    if entry.numbers:
        output += ["", Table("Its own numbers", ["number", "default", "meaning"], list(entry.numbers), words=True)]
    return output


def first_sentence(text: str) -> str:
    """The text up to the first full stop that ends a sentence, on one line."""
    return re.split(r"(?<=\.)\s", " ".join(text.split()), maxsplit=1)[0]


def fitted(documentation: str, width: int) -> str:
    """A docstring without its attributes: sentences fill the width, equations keep their lines while these fit."""
    paragraphs = [part for part in documentation.split("\n\n") if not part.startswith(ATTRIBUTES)]
    return "\n\n".join(_fitted_paragraph(part, width) for part in paragraphs)


def _fitted_paragraph(text: str, width: int) -> str:
    if text[0] != " " and not text.startswith(ERRORS):
        return textwrap.fill(" ".join(text.split()), width, break_on_hyphens=False)
    return "\n".join(_fitted_equations(line, width) for line in text.splitlines())


def _fitted_equations(line: str, width: int) -> str:
    """A line of equations, broken where two spaces part them; the rest stands below the first one."""
    equations = re.sub(r"^ *([\w, ]+: +)?", "", line)
    label = len(line) - len(equations)
    lines, parts = [line[:label]], re.split(r"(?<=\S)  (?=\S)", equations)
    for number, part in enumerate(parts):
        if number and len(lines[-1]) + 2 + len(part) <= width:
            lines[-1] += "  " + part
            continue
        first = " " * label if number else lines.pop()
        rest = " " * (label + 2)
        lines += textwrap.wrap(part, width, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False)
    return "\n".join(lines)


def _meanings(kind: type[Filter]) -> dict[str, str]:
    """The descriptions of attributes in the docstrings of a class and of its bases."""
    meanings = {}
    for base in reversed(kind.__mro__):
        text = cleandoc(base.__doc__ or "")
        for section in (part for part in text.split("\n\n") if part.startswith(ATTRIBUTES)):
            for name, meaning in re.findall(r"^    (\w+): (.*(?:\n     .*)*)", section, flags=re.MULTILINE):
                meanings[name] = " ".join(meaning.split())
    return meanings


def _yes(answer: bool) -> str:
    return "yes" if answer else "no"


def _plain(entry: Entry) -> dict:
    return {**entry._asdict(), "numbers": [number._asdict() for number in entry.numbers]}


NEEDS = "needs"
HEADS = ("method", "what it does", "use it", NEEDS)


def methods(name: Annotated[str | None, Argument(INPUT, choices=METHODS)] = None) -> Printed:
    """List the methods of tuning of `thruster tune --method`, or show one with its equations and source.

    Those that need a gradient accept kf, ekf, iekf, ukf, ckf, ekf-robust, sage-husa and vb; searches accept any
    filter, the others any filter with a covariance.

    Example: thruster methods em

    Args:
        name: a method to show in full.
    """
    chosen = None if name is None else find_method(name)  # a clear error for an unknown one
    data: dict[str, Any] = {
        label: {"about": method.about, "when": method.when, "source": method.source, NEEDS: list(method.needs)}
        for label, method in METHODS.items()
        if name in (None, label)
    }
    if chosen is not None:
        text = getdoc(chosen.function) or ""
        words = [f"{name}: {chosen.about}.", f"Use it {chosen.when}.", f"Source: {chosen.source}", text]
        return Printed(words, data)
    rows = [[label, method.about, method.when, _needs(method.needs)] for label, method in METHODS.items()]
    return Printed([Table("methods of tuning: thruster tune --method NAME", HEADS, rows, words=True)], data)


def _needs(needs: tuple[str, ...]) -> str:
    words = {TRUTH: "true states", GRADIENT: "a gradient"}
    return ", ".join(words[need] for need in needs if need in words)
