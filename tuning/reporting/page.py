"""A self-contained page: tables and pictures in one HTML file that needs no network, and tables as Markdown.

In order: figures as SVG whose text, colours and values a browser can use; the parts of a page and the page; text
alternatives of pictures, for readers who cannot see them.
"""

from __future__ import annotations

import colorsys
import io
import json
import re
import unicodedata
from collections.abc import Sequence
from html import escape
from itertools import count, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from thruster_env.core.text_tables import Table, markdown_text, typeset, typeset_html
from tuning.evaluation.sizes import SizeRow

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

# Of tables and pictures on a page.
STYLE, SCRIPT = (Path(__file__).with_name(f"report.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
WIDE = 480.0  # [pt] pictures beyond this are scrolled on a phone


def figure_svg(figure: Figure, name: str) -> tuple[str, str]:
    """A figure as an SVG element without its size and its alternative text, and its readable values as JSON.

    Args:
        figure: of matplotlib.
        name: of the picture, which comes before all ids: several stand on one page.
    """
    from matplotlib import rc_context

    for number, axis in enumerate(figure.axes):
        axis.set_gid(f"axes{number}")
        for row, line in enumerate(axis.lines):
            line.set_gid(f"line{number}-{row}")
    stream = io.BytesIO()
    with rc_context(OPTIONS):
        figure.savefig(stream, format="svg", transparent=True, metadata=NO_METADATA)
    text = stream.getvalue().decode()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(
        r"<!--.*?-->\s*|\n\s*", lambda match: "" if match[0].startswith("<!") else "\n", text, flags=re.S
    )
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", text)
    text = FONTS.sub("'DejaVu Sans', sans-serif", text.replace("xlink:href", "href"))
    digits = 1 if len(text) > LARGE else 2
    text = PLACES.sub(lambda match: f'{match[1]}="{_short(match[2], digits)}"', text)
    text = COLOUR.sub(lambda match: f"var(--c-{match[1].lower()})", text)
    head, _, body = text.partition(">")
    box = re.search(r'viewBox="([^"]*)"', head)
    assert box is not None  # matplotlib always writes it
    return f'<svg viewBox="{box[1]}">{body.strip()}', _readings(figure, name)


def palette(page: str) -> str:
    """Style sheet of the colours that a page's pictures use, on white paper and on dark."""
    used = sorted(set(re.findall(r"var\(--c-([0-9a-f]{6})\)", page)))
    light = "".join(f"--c-{colour}:#{colour};" for colour in used)
    dark = "".join(f"--c-{colour}:{on_dark(f'#{colour}')};" for colour in used)
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

    def letter(match: re.Match) -> str:
        try:
            return unicodedata.lookup(f"GREEK SMALL LETTER {match[1].upper()}")
        except KeyError:
            return match[1]

    return " ".join(re.sub(r"[${}]", "", re.sub(r"\\([a-zA-Z]+)", letter, label)).split())


def _readings(figure: Figure, name: str) -> str:
    """Positions and contents of axes, and their readable lines; empty if there is none."""
    width, height = figure.get_size_inches() * 72.0
    readings = [_axes(axis, number, name, width, height) for number, axis in enumerate(figure.axes)]
    readings = [reading for reading in readings if reading["lines"]]
    return escape(json.dumps(readings, separators=(",", ":")), quote=True) if readings else ""


def _axes(axis: Axes, number: int, name: str, width: float, height: float) -> dict[str, Any]:
    box = axis.get_position()
    lines = [
        [f"{name}-line{number}-{row}", plain(label if not label.startswith("_") else axis.get_ylabel())]
        for row, (line, label) in enumerate((line, str(line.get_label())) for line in axis.lines)
        if len(line.get_path()) >= READ_FROM and line.get_linestyle() != "None"
    ]
    return {
        "id": f"{name}-axes{number}",
        "box": [round(part, 2) for part in (box.x0 * width, (1 - box.y1) * height, box.x1 * width)]
        + [round((1 - box.y0) * height, 2)],
        "x": [float(part) for part in axis.get_xlim()],
        "y": [float(part) for part in axis.get_ylim()],
        "log": [axis.get_xscale() == "log", axis.get_yscale() == "log"],
        "label": plain(axis.get_xlabel()),
        "lines": lines,
    }


def _short(coordinates: str, digits: int) -> str:
    """Coordinates to so many digits of a point."""
    coordinates = coordinates.replace("\n", " ")
    return re.sub(
        r"-?\d+\.\d+", lambda match: f"{float(match[0]):.{digits}f}".rstrip("0").rstrip("."), coordinates
    )


def _parts(colour: str) -> tuple[float, ...]:
    return tuple(int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))


def _hex(parts: tuple[float, ...]) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in parts)


class Picture(NamedTuple):
    """A picture with a caption and a text alternative."""

    svg: str  # an element without a size
    caption: str
    alt: str
    readings: str = ""  # what a script reads off the picture

    def html(self) -> str:
        """The picture within the page itself."""
        match = re.match(r'<svg viewBox="0 0 ([\d.]+) ([\d.]+)"', self.svg)
        width, height = (float(part) for part in match.groups()) if match else (0.0, 0.0)
        size = f'width="{width * 4 / 3:.0f}" height="{height * 4 / 3:.0f}"'
        kinds = [name for name, applies in (("read", self.readings), ("wide", width > WIDE)) if applies]
        marks = f' class="{" ".join(kinds)}"' if kinds else ""
        read = f' data-read="{typeset(self.readings)}"' if self.readings else ""
        svg = typeset(self.svg).replace("<svg", f'<svg role="img" aria-label="{typeset_html(self.alt)}" {size}', 1)
        return (
            f'<figure{marks}{read}><div class="picture">{svg}</div>'
            f"<figcaption>{typeset_html(self.caption)}</figcaption></figure>"
        )


class Code(NamedTuple):
    """Lines to copy."""

    title: str
    text: str
    folded: bool = False  # whether they are shown on a click alone

    def html(self) -> str:
        """The lines below their title."""
        lines = f'<div class="code"><pre>{escape(self.text)}</pre></div>'
        if self.folded:
            return f"<details><summary>{escape(self.title)}</summary>{lines}</details>"
        return f"<h3>{escape(self.title)}</h3>{lines}"


class Words(NamedTuple):
    """Sentences: one as a paragraph, several as a list."""

    sentences: Sequence[str]

    def html(self) -> str:
        """A paragraph or a list."""
        if len(self.sentences) == 1:
            return f"<p>{typeset_html(self.sentences[0])}</p>"
        return f"<ul>{''.join(f'<li>{typeset_html(sentence)}</li>' for sentence in self.sentences)}</ul>"


def as_parts(results: Sequence[Table | str]) -> list[Part]:
    """Tables and sentences of a result as parts of a page."""
    parts: list[Part] = []
    for is_text, group in groupby(results, lambda part: isinstance(part, str)):
        entries: list[Any] = list(group)
        sentences = [line for text in entries for line in text.splitlines() if line] if is_text else []
        parts += entries if not is_text else [Words(sentences)] if sentences else []
    return parts


Part = Table | Picture | Words | Code


class Section(NamedTuple):
    """A heading and what stands below it."""

    title: str
    parts: Sequence[Part]

    @property
    def anchor(self) -> str:
        """The targets of a table of contents."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


def html_page(title: str, advice: str | Sequence[str], sections: Sequence[Section]) -> str:
    """The whole page; all text is escaped.

    Args:
        title: of the page.
        advice: the summary, a sentence or several.
        sections: what follows.
    """
    sentences = [advice] if isinstance(advice, str) else advice
    paragraphs = "\n".join(f'<p class="advice">{escape(sentence)}</p>' for sentence in sentences)
    contents = "".join(f'<li><a href="#{section.anchor}">{escape(section.title)}</a></li>' for section in sections)
    body = "\n".join(
        f'<section id="{section.anchor}">\n<h2>{escape(section.title)}</h2>\n'
        + "\n".join(part.html() for part in section.parts)
        + "\n</section>"
        for section in sections
    )
    script = f"\n<script>{SCRIPT}</script>" if "data-read=" in body or 'class="code"' in body else ""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}{palette(body)}</style>\n</head>\n<body>\n<main>\n"
        f"<h1>{escape(title)}</h1>\n{paragraphs}\n"
        f'<nav aria-label="contents"><strong>Contents</strong><ol>{contents}</ol></nav>\n'
        f"{body}\n</main>{script}\n</body>\n</html>\n"
    )


def markdown_page(title: str, results: Sequence[Table | str]) -> str:
    """A title, tables and sentences as Markdown."""
    parts = [part.markdown() if isinstance(part, Table) else markdown_text(str(part)) for part in results]
    return "\n\n".join([f"# {markdown_text(title)}", *filter(None, parts)]) + "\n"


def of_sizes(sizes: Sequence[SizeRow], chosen: int) -> str:
    """RMSE at the smallest, the kept and the largest size."""
    states, sentences = sizes[0].evaluation.states, []
    for i, state in enumerate(states):
        ends = {sizes[0].size, chosen, sizes[-1].size}
        values = [f"{row.evaluation.rmse[i].value:.3g} at N = {row.size}" for row in sizes if row.size in ends]
        sentences.append(f"RMSE of {state.name}{f' in {state.unit}' if state.unit else ''}: {', '.join(values)}")
    return f"{'; '.join(sentences)}."


class Sketchbook:
    """Numbers pictures, each with a caption and a text alternative."""

    def __init__(self):
        """Pictures are called by a number."""
        self._names = (f"p{number}" for number in count(1))

    def picture(self, figure: Figure, caption: str, alt: str) -> Picture:
        """A figure as a part of a page."""
        svg, readings = figure_svg(figure, next(self._names))
        return Picture(svg, caption, alt, readings)


def of_series(names: Sequence[str], values: np.ndarray, units: Sequence[str]) -> str:
    """Range and mean of every column of values (K, m), and how many are missing."""
    sentences = []
    for name, unit, column in zip(names, units, values.T, strict=True):
        finite = column[np.isfinite(column)]
        if not finite.size:
            sentences.append(f"{name}: nothing")
            continue
        missing = f", {len(column) - len(finite)} of {len(column)} missing" if len(finite) < len(column) else ""
        ends = f"from {finite.min():.3g} to {finite.max():.3g} {unit}".rstrip()
        sentences.append(f"{name} {ends}, mean {finite.mean():.3g}{missing}")
    return f"{'; '.join(sentences)}."
