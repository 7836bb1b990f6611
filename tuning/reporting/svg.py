"""Figures as SVG within a page: text stays text, colours follow the page's, and a script can read values."""

from __future__ import annotations

import colorsys
import io
import json
import re
import unicodedata
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAPER = "#ffffff"
DARK_PAPER = "#15191d"
LEGIBLE = 0.22  # luminance of a colour on dark paper, at least
GREYISH = 0.15  # saturation below which a colour is a grey
LARGE = 400_000  # bytes of a picture whose coordinates are rounded to a tenth of a point
READ_FROM = 30  # points of a line whose values can be read off
OPTIONS: Any = {"svg.fonttype": "none", "svg.hashsalt": "report", "path.simplify": True}
NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}
PLACES = re.compile(r'\b(d|x|y|x1|x2|y1|y2|points|transform)="([^"]*)"')
FONTS = re.compile(r"'DejaVu Sans',[^;\"]*sans-serif")
COLOUR = re.compile(r"#([0-9a-fA-F]{6})\b")


def figure_svg(figure: Figure, name: str) -> tuple[str, str]:
    """A figure as an SVG element without its size and its alternative text, and its readable values as JSON.

    Args:
        figure: of matplotlib.
        name: of the picture, which comes before all ids: several stand on one page.
    """
    from matplotlib import rc_context

    for place, axis in enumerate(figure.axes):
        axis.set_gid(f"axes{place}")
        for row, line in enumerate(axis.lines):
            line.set_gid(f"line{place}-{row}")
    stream = io.BytesIO()
    with rc_context(OPTIONS):
        figure.savefig(stream, format="svg", transparent=True, metadata=NO_METADATA)
    text = stream.getvalue().decode()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(
        r"<!--.*?-->\s*|\n\s*", lambda found: "" if found[0].startswith("<!") else "\n", text, flags=re.S
    )
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", text)
    text = FONTS.sub("'DejaVu Sans', sans-serif", text.replace("xlink:href", "href"))
    places = 1 if len(text) > LARGE else 2
    text = PLACES.sub(lambda found: f'{found[1]}="{_short(found[2], places)}"', text)
    text = COLOUR.sub(lambda found: f"var(--c-{found[1].lower()})", text)
    head, _, body = text.partition(">")
    box = re.search(r'viewBox="([^"]*)"', head)
    assert box is not None  # matplotlib always writes it
    return f'<svg viewBox="{box[1]}">{body.strip()}', _readings(figure, name)


def palette(page: str) -> str:
    """Style sheet of the colours that a page's pictures use, on white paper and on dark."""
    used = sorted(set(re.findall(r"var\(--c-([0-9a-f]{6})\)", page)))
    light = "".join(f"--c-{one}:#{one};" for one in used)
    dark = "".join(f"--c-{one}:{on_dark(f'#{one}')};" for one in used)
    return (
        f":root{{{light}}}\n@media screen and (prefers-color-scheme: dark){{:root:not(.light){{{dark}}}}}\n"
        f"@media screen{{:root.dark{{{dark}}}}}"
    )


def luminance(colour: str) -> float:
    """Relative luminance of a colour "#rrggbb", from 0 to 1, as WCAG 2 defines it."""
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in _parts(colour)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def on_dark(colour: str) -> str:
    """What a colour "#rrggbb" of a picture becomes on dark paper: greys change sides, others grow light enough."""
    if colour.lower() == PAPER:
        return DARK_PAPER
    parts = _parts(colour)
    hue, lightness, saturation = colorsys.rgb_to_hls(*parts)
    if saturation < GREYISH:
        return _hex(colorsys.hls_to_rgb(hue, 1.0 - 0.8 * lightness, saturation))
    while luminance(_hex(parts)) < LEGIBLE:
        parts = tuple(part + 0.05 * (1.0 - part) for part in parts)
    return _hex(parts)


def plain(label: str) -> str:
    """A label of a figure without its mathematics: of a Greek letter in TeX it is that letter."""

    def letter(found: re.Match) -> str:
        try:
            return unicodedata.lookup(f"GREEK SMALL LETTER {found[1].upper()}")
        except KeyError:
            return found[1]

    return " ".join(re.sub(r"[${}]", "", re.sub(r"\\([a-zA-Z]+)", letter, label)).split())


def _readings(figure: Figure, name: str) -> str:
    """Positions and contents of axes, and their readable lines; empty if there is none."""
    width, height = figure.get_size_inches() * 72.0
    found = [_axes(axis, place, name, width, height) for place, axis in enumerate(figure.axes)]
    found = [one for one in found if one["lines"]]
    return escape(json.dumps(found, separators=(",", ":")), quote=True) if found else ""


def _axes(axis: Axes, place: int, name: str, width: float, height: float) -> dict[str, Any]:
    box = axis.get_position()
    lines = [
        [f"{name}-line{place}-{row}", plain(label if not label.startswith("_") else axis.get_ylabel())]
        for row, (line, label) in enumerate((line, str(line.get_label())) for line in axis.lines)
        if len(line.get_path()) >= READ_FROM and line.get_linestyle() != "None"
    ]
    return {
        "id": f"{name}-axes{place}",
        "box": [round(part, 2) for part in (box.x0 * width, (1 - box.y1) * height, box.x1 * width)]
        + [round((1 - box.y0) * height, 2)],
        "x": [float(part) for part in axis.get_xlim()],
        "y": [float(part) for part in axis.get_ylim()],
        "log": [axis.get_xscale() == "log", axis.get_yscale() == "log"],
        "label": plain(axis.get_xlabel()),
        "lines": lines,
    }


def _short(places: str, digits: int) -> str:
    """Coordinates to so many digits of a point."""
    places = places.replace("\n", " ")
    return re.sub(r"-?\d+\.\d+", lambda found: f"{float(found[0]):.{digits}f}".rstrip("0").rstrip("."), places)


def _parts(colour: str) -> tuple[float, ...]:
    return tuple(int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))


def _hex(parts: tuple[float, ...]) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in parts)
