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
def own(name: str) -> Markup:
    """A style or script of the page."""
    return Markup((HERE / name).read_text(encoding="utf-8"))


def signals(bench: Bench) -> list[tuple[str, str, str]]:
    """Name, title and description of each picture over time."""
    found = []
    for place, one in enumerate(bench.states):
        named = _named(one)
        found.append((f"state{place}", named, f"{named} over time, with the 95 % band of its estimate"))
    for place, one in enumerate(bench.measurements):
        named = f"Innovation of {_named(one)}"
        found.append((f"innovation{place}", named, f"{named} over time, with its 95 % band"))
    found.append(
        ("nis", "NIS", "Normalised innovation squared over time, with the interval of its mean over runs")
    )
    if bench.has_truth:
        found.append(("nees", "NEES", "Normalised estimation error squared over time, with its interval"))
    found.append(("autocorrelation", "Autocorrelation of innovations", "Autocorrelation over lags, with its band"))
    return found


def _named(one: Quantity) -> str:
    return f"{one.name} [{one.unit}]" if one.unit else one.name


def page_of(bench: Bench, seeds: int = SEEDS) -> Callable[[Document], None]:
    """What fills the document of each new tab: with a bench, or with the scene that the address names."""

    def fill(document: Document) -> None:
        scene = SCENES.get(_asked(document))
        here = bench if scene is None else scene.bench()
        document.title = f"{here.title}: explore"
        document.template = template()
        document.template_variables.update(
            heading=here.title,
            css=own("page.css"),
            js=own("page.js"),
            kinds=list(KINDS.items()),
            signals=signals(here),
            scenes=[(one.name, one.title) for one in SCENES.values()],
            scene=scene,
            has_truth=here.has_truth,
        )
        Session(document, here, seeds, scene)

    return fill


def _asked(document: Document) -> str:
    """The scene that the address asks for; empty if none."""
    context = document.session_context
    given = getattr(context.request, "arguments", {}) if context is not None else {}
    return b"".join(given.get("scene", [])[:1]).decode(errors="replace")
