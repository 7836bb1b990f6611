"""A self-contained page: tables and pictures in one HTML file that needs no network, and tables as Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

from tuning.reporting.script import SCRIPT
from tuning.reporting.style import STYLE
from tuning.reporting.svg import palette
from tuning.reporting.units import typeset

INTERVAL = re.compile(r"(\S+) (\[\S+, \S+\])")
WIDE = 480.0  # [pt] pictures beyond this are scrolled on a phone
MANY = 9  # columns of a table that is set small on paper
FOLDED = 4  # columns from which a row is folded on a phone
NARROW = 5  # columns of a table that fits beside another


class Table(NamedTuple):
    """A table of words: the first column names the row."""

    caption: str
    columns: Sequence[str]  # empty for a list of names and what they are
    rows: Sequence[Sequence[str]]

    def html(self) -> str:
        """The table for a page: on a phone a row of many columns is folded; if still too wide, it scrolls."""
        head = "".join(f'<th scope="col">{_text(column)}</th>' for column in self.columns)
        rows = "\n".join(
            f'<tr><th scope="row">{_text(row[0])}</th>{self._cells(row[1:])}</tr>' for row in self.rows
        )
        head = f"<thead><tr>{head}</tr></thead>\n" if head else ""
        kind, label = ("", _text(self.caption)) if self.columns else (' class="words"', "a list")
        if len(self.columns) >= MANY:
            kind = ' class="many fold"'
        elif len(self.columns) >= FOLDED:
            kind = ' class="fold"'
        caption = f'<p class="caption">{_text(self.caption)}</p>\n' if self.caption else ""
        scroll = f'<div class="scroll" role="region" aria-label="{label}" tabindex="0">'
        return f"{caption}{scroll}<table{kind}>\n{head}<tbody>\n{rows}\n</tbody></table></div>"

    def _cells(self, cells: Sequence[str]) -> str:
        """Cells of a row, each with the head of its column where there is one, for a folded row."""
        heads = self.columns[1:] if len(self.columns) >= FOLDED else ("",) * len(cells)
        return "".join(_cell(cell, head) for cell, head in zip(cells, heads, strict=True))

    def markdown(self) -> str:
        """The table for a Markdown file, its caption above."""
        columns = self.columns or ("",) * len(self.rows[0])
        lines = [_line(columns), _line(["---", *["---:"] * (len(columns) - 1)]), *map(_line, self.rows)]
        return "\n".join([*([f"**{_plain(self.caption)}**", ""] if self.caption else []), *lines])


class Picture(NamedTuple):
    """A picture with a caption and a text alternative."""

    svg: str  # an element without a size
    caption: str
    alt: str
    readings: str = ""  # what a script reads off the picture

    def html(self) -> str:
        """The picture within the page itself."""
        found = re.match(r'<svg viewBox="0 0 ([\d.]+) ([\d.]+)"', self.svg)
        width, height = (float(part) for part in found.groups()) if found else (0.0, 0.0)
        size = f'width="{width * 4 / 3:.0f}" height="{height * 4 / 3:.0f}"'
        kinds = [name for name, there in (("read", self.readings), ("wide", width > WIDE)) if there]
        marks = f' class="{" ".join(kinds)}"' if kinds else ""
        read = f' data-read="{typeset(self.readings)}"' if self.readings else ""
        svg = typeset(self.svg).replace("<svg", f'<svg role="img" aria-label="{_text(self.alt)}" {size}', 1)
        return (
            f'<figure{marks}{read}><div class="picture">{svg}</div>'
            f"<figcaption>{_text(self.caption)}</figcaption></figure>"
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
            return f"<p>{_text(self.sentences[0])}</p>"
        return f"<ul>{''.join(f'<li>{_text(sentence)}</li>' for sentence in self.sentences)}</ul>"


class Pair(NamedTuple):
    """Parts of two studies side by side where there is room, each below the name of its study."""

    names: Sequence[str]
    parts: Sequence[Table | Picture | Words | Code | None]

    def html(self) -> str:
        """A grid of the parts; one that is the same in both stands once."""
        first, second = self.parts
        if first is not None and second is not None and first == second:
            return first.html()
        cells = "".join(
            f'<div><p class="whose">{escape(name)}</p>{part.html() if part else ""}</div>'
            for name, part in zip(self.names, self.parts, strict=True)
        )
        tables = [one for one in self.parts if isinstance(one, Table)]
        kind = "pair close" if not tables else "pair"
        kind += " deep" if any(len(one.columns) > NARROW for one in tables) else ""
        return f'<div class="{kind}">{cells}</div>'


Part = Table | Picture | Words | Code | Pair


class Section(NamedTuple):
    """A heading and what stands below it."""

    title: str
    parts: Sequence[Part]

    @property
    def anchor(self) -> str:
        """The targets of a table of contents."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


def html_page(
    title: str, advice: str | Sequence[str], sections: Sequence[Section], two_columns: bool = False
) -> str:
    """The whole page; all text is escaped.

    Args:
        title: of the page.
        advice: the summary, a sentence or several.
        sections: what follows.
        two_columns: whether it is wide, for two studies.
    """
    told = [advice] if isinstance(advice, str) else advice
    said = "\n".join(f'<p class="advice">{escape(one)}</p>' for one in told)
    contents = "".join(f'<li><a href="#{one.anchor}">{escape(one.title)}</a></li>' for one in sections)
    body = "\n".join(
        f'<section id="{section.anchor}">\n<h2>{escape(section.title)}</h2>\n'
        + "\n".join(part.html() for part in section.parts)
        + "\n</section>"
        for section in sections
    )
    script = f"\n<script>{SCRIPT}</script>" if "data-read=" in body or 'class="code"' in body else ""
    kind = ' class="two-columns"' if two_columns else ""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}{palette(body)}</style>\n</head>\n<body{kind}>\n<main>\n"
        f"<h1>{escape(title)}</h1>\n{said}\n"
        f'<nav aria-label="contents"><strong>Contents</strong><ol>{contents}</ol></nav>\n'
        f"{body}\n</main>{script}\n</body>\n</html>\n"
    )


def markdown_page(title: str, advice: str, tables: Sequence[Table]) -> str:
    """Title, advice and tables as Markdown."""
    return "\n\n".join([f"# {_plain(title)}", _plain(advice), *(one.markdown() for one in tables)]) + "\n"


def _cell(text: str, head: str = "") -> str:
    """A cell of a page; the interval of a value stands below it, and the head of its column is kept with it."""
    found = INTERVAL.fullmatch(text)
    value, below = (found[1], f"<small>{escape(found[2])}</small>") if found else (text, "")
    named = f' data-head="{_text(head)}"' if head else ""
    return f"<td{named}>{_text(value)}{below}</td>"


def _text(text: str) -> str:
    """Text of a page, its units typeset."""
    return escape(typeset(text))


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(_plain(cell) for cell in cells) + " |"


def _plain(text: str) -> str:
    """Text that Markdown takes as it is."""
    text = re.sub(r"([\\|*_`<$~])", r"\\\1", " ".join(text.split()))
    text = text.replace("](", "\\](").replace("![", "!\\[").replace("&", "&amp;")
    return f"\\{text}" if text[:1] in ("#", ">") else text
