"""The document of a tab: the template around the pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

from bokeh.document import Document
from jinja2 import Environment, FileSystemLoader, Template
from markupsafe import Markup

from thruster_env.model.quantities import Quantity
from tuning.exploring.bench import Bench
from tuning.exploring.page.export import KINDS
from tuning.exploring.page.session import Session
from tuning.exploring.scenes import SCENES

HERE = Path(__file__).parent
SEEDS = 8


@cache
def template() -> Template:
    """The page, whose texts are escaped where they are put in."""
    return Environment(autoescape=True, loader=FileSystemLoader(HERE)).get_template("page.html")


@cache
def asset(name: str) -> Markup:
    """A style or script of the page."""
    return Markup((HERE / name).read_text(encoding="utf-8"))


def signals(bench: Bench) -> list[tuple[str, str, str]]:
    """Name, title and description of each picture over time."""
    rows = []
    for i, quantity in enumerate(bench.states):
        named = _named(quantity)
        rows.append((f"state{i}", named, f"{named} over time, with the 95 % band of its estimate"))
    for i, quantity in enumerate(bench.measurements):
        named = f"Innovation of {_named(quantity)}"
        rows.append((f"innovation{i}", named, f"{named} over time, with its 95 % band"))
    rows.append(("nis", "NIS", "Normalised innovation squared over time, with the interval of its mean over runs"))
    if bench.has_truth:
        rows.append(("nees", "NEES", "Normalised estimation error squared over time, with its interval"))
    rows.append(("autocorrelation", "Autocorrelation of innovations", "Autocorrelation over lags, with its band"))
    return rows


def _named(quantity: Quantity) -> str:
    return f"{quantity.name} [{quantity.unit}]" if quantity.unit else quantity.name


def page_of(bench: Bench, seeds: int = SEEDS) -> Callable[[Document], None]:
    """What fills the document of each new tab: with a bench, or with the scene that the address names."""

    def fill(document: Document) -> None:
        scene = SCENES.get(_asked(document))
        here = bench if scene is None else scene.bench()
        document.title = f"{here.title}: explore"
        document.template = template()
        document.template_variables.update(
            heading=here.title,
            css=asset("page.css"),
            js=asset("page.js"),
            kinds=list(KINDS.items()),
            signals=signals(here),
            scenes=[(scene_.name, scene_.title) for scene_ in SCENES.values()],
            scene=scene,
            has_truth=here.has_truth,
        )
        Session(document, here, seeds, scene)

    return fill


def _asked(document: Document) -> str:
    """The scene that the address asks for; empty if none."""
    context = document.session_context
    arguments = getattr(context.request, "arguments", {}) if context is not None else {}
    return b"".join(arguments.get("scene", [])[:1]).decode(errors="replace")
