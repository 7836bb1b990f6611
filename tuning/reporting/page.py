"""A page of its own: tables and pictures in one HTML file that needs no network, and tables as Markdown."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

INTERVAL = re.compile(r"(\S+) (\[\S+, \S+\])")
WIDE = 800  # [px] pictures beyond this are scrolled on a phone
STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 60rem; padding: 1.5rem 1rem 4rem; background: #fff; color: #222;
       font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 1rem; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .5rem; padding-top: .75rem; border-top: 1px solid #ddd; }
p, ul { max-width: 46rem; }
.advice { margin: 0 0 1rem; padding: .75rem 1rem; border-left: 4px solid #0b6fa4; background: #f1f6f9;
          font-size: 1.1rem; }
.scroll { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
.caption { font-weight: 600; margin: 1.25rem 0 0; }
.caption + .scroll { margin-top: .35rem; }
th, td { padding: .3rem 0 .3rem 1.1rem; text-align: right; vertical-align: top; border-bottom: 1px solid #e4e4e4; }
th:first-child { text-align: left; padding-left: 0; position: sticky; left: 0; background: #fff; }
td { white-space: nowrap; }
td small { display: block; color: #444; }
table.words td { text-align: left; white-space: normal; }
thead th { border-bottom: 2px solid #bbb; vertical-align: bottom; }
figure { margin: 1rem 0; overflow-x: auto; }
img { display: block; max-width: 100%; height: auto; }
figcaption { color: #444; font-size: .92rem; position: sticky; left: 0; }
@media (max-width: 40rem) {
  body { padding: 1rem .75rem 3rem; }
  h1 { font-size: 1.35rem; }
  th, td { padding-left: .7rem; }
  th:first-child { max-width: 6.5rem; }
  img.wide { max-width: none; width: 38rem; }
}
@media print { figure, table { break-inside: avoid; } }
"""


class Table(NamedTuple):
    """A table of words: the first column names the row."""

    caption: str
    columns: Sequence[str]  # empty for a list of names and what they are
    rows: Sequence[Sequence[str]]

    def html(self) -> str:
        """The table for a page; what is too wide is scrolled by itself."""
        head = "".join(f'<th scope="col">{escape(column)}</th>' for column in self.columns)
        rows = "\n".join(
            f'<tr><th scope="row">{escape(row[0])}</th>{"".join(map(_cell, row[1:]))}</tr>' for row in self.rows
        )
        head = f"<thead><tr>{head}</tr></thead>\n" if head else ""
        kind, label = ("", escape(self.caption)) if self.columns else (' class="words"', "a list")
        caption = f'<p class="caption">{escape(self.caption)}</p>\n' if self.caption else ""
        scroll = f'<div class="scroll" role="region" aria-label="{label}" tabindex="0">'
        return f"{caption}{scroll}<table{kind}>\n{head}<tbody>\n{rows}\n</tbody></table></div>"

    def markdown(self) -> str:
        """The table for a Markdown file, its caption above."""
        columns = self.columns or ("",) * len(self.rows[0])
        lines = [_line(columns), _line(["---", *["---:"] * (len(columns) - 1)]), *map(_line, self.rows)]
        return "\n".join([*([f"**{_plain(self.caption)}**", ""] if self.caption else []), *lines])


class Picture(NamedTuple):
    """A picture with a sentence below, which is what one hears who cannot see it."""

    png: bytes
    caption: str

    def html(self) -> str:
        """The picture within the page itself."""
        data = base64.b64encode(self.png).decode()
        said = escape(self.caption)
        width, height = (int.from_bytes(self.png[place : place + 4]) for place in (16, 20))  # of the PNG's header
        size = f'width="{width}" height="{height}"' + (' class="wide"' if width > WIDE else "")
        image = f'<img alt="{said}" {size} src="data:image/png;base64,{data}">'
        return f"<figure>{image}<figcaption>{said}</figcaption></figure>"


class Words(NamedTuple):
    """Sentences: one as a paragraph, several as a list."""

    sentences: Sequence[str]

    def html(self) -> str:
        """A paragraph or a list."""
        if len(self.sentences) == 1:
            return f"<p>{escape(self.sentences[0])}</p>"
        return f"<ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in self.sentences)}</ul>"


class Section(NamedTuple):
    """A heading and what stands below it."""

    title: str
    parts: Sequence[Table | Picture | Words]


def html_page(title: str, advice: str, sections: Sequence[Section]) -> str:
    """The whole page; all that is said is escaped."""
    body = "\n".join(
        f"<section>\n<h2>{escape(section.title)}</h2>\n"
        + "\n".join(part.html() for part in section.parts)
        + "\n</section>"
        for section in sections
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        f'<h1>{escape(title)}</h1>\n<p class="advice">{escape(advice)}</p>\n{body}\n</main>\n</body>\n</html>\n'
    )


def markdown_page(title: str, advice: str, tables: Sequence[Table]) -> str:
    """Title, advice and tables as Markdown."""
    return "\n\n".join([f"# {_plain(title)}", _plain(advice), *(one.markdown() for one in tables)]) + "\n"


def _cell(text: str) -> str:
    """A cell of a page; the interval of a value stands below it."""
    found = INTERVAL.fullmatch(text)
    value, below = (found[1], f"<small>{escape(found[2])}</small>") if found else (text, "")
    return f"<td>{escape(value)}{below}</td>"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(_plain(cell) for cell in cells) + " |"


def _plain(text: str) -> str:
    """Text that Markdown takes as it is."""
    for mark in "\\|*_`<":
        text = text.replace(mark, f"\\{mark}")
    return " ".join(text.split())
