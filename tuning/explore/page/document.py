"""The document of a tab: the template around the pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

from bokeh.document import Document
from jinja2 import Environment, FileSystemLoader, Template
from markupsafe import Markup

from tuning.explore.bench import Bench
from tuning.explore.export import KINDS
from tuning.explore.page.session import Session

HERE = Path(__file__).parent
SEEDS = 8


@cache
def template() -> Template:
    """The page, whose texts are escaped where they are put in."""
    return Environment(autoescape=True, loader=FileSystemLoader(HERE)).get_template("page.html")


@cache
def own(name: str) -> Markup:
    """A style or script of the page."""
    return Markup((HERE / name).read_text(encoding="utf-8"))


def signals(bench: Bench) -> list[tuple[str, str, str]]:
    """Name, title and description of each picture over time."""
    found = []
    for place, (name, unit) in enumerate(bench.states):
        found.append(
            (
                f"state{place}",
                f"State: {name}",
                f"{name} in {unit or 'its unit'} over time, estimate in its 95 % band",
            )
        )
    for place, (name, _) in enumerate(bench.measurements):
        found.append(
            (f"innovation{place}", f"Innovation: {name}", f"innovation of {name} over time, in its 95 % band")
        )
    found.append(("nis", "NIS, mean of all runs, in its 95 % interval", "normalised innovation squared over time"))
    if bench.has_truth:
        found.append(
            (
                "nees",
                "NEES, mean of all runs, in its 95 % interval",
                "normalised estimation error squared over time",
            )
        )
    found.append(
        (
            "autocorrelation",
            "Autocorrelation of the innovations, white within the band",
            "autocorrelation over lags",
        )
    )
    return found


def page_of(bench: Bench, seeds: int = SEEDS) -> Callable[[Document], None]:
    """What fills the document of each new tab with a bench."""

    def fill(document: Document) -> None:
        document.title = f"{bench.title}: explore"
        document.template = template()
        document.template_variables.update(
            heading=bench.title,
            css=own("page.css"),
            js=own("page.js"),
            kinds=list(KINDS.items()),
            signals=signals(bench),
        )
        Session(document, bench, seeds)

    return fill
