"""Tables of text: in Markdown, for the terminal, and as plain text, with substitutes for missing characters."""

from __future__ import annotations

import codecs
import re
import unicodedata
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from html import escape
from io import StringIO
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType, RenderResult
from rich.table import Table as RichTable
from rich.text import Text


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("".join(f"| {cell} " if cell else "| " for cell in line) + "|" for line in lines)


def with_tables(page: str, tables: Mapping[str, Callable[[], str]]) -> str:
    """The page with these computed tables written anew; others stay.

    A table stands between `<!-- table NAME -->` and `<!-- end -->`.
    """

    def anew(match: re.Match) -> str:
        if match[2] not in tables:
            return match[0]
        return f"{match[1]}\n{tables[match[2]]()}\n{match[3]}"

    return re.sub(r"(<!-- table ([^\n]+?) -->).*?(<!-- end -->)", anew, page, flags=re.DOTALL)


HANDLER = "thruster: other characters"  # name among Python's error handlers of encodings
OTHERS = {"±": "+-", "×": "x", "µ": "u", "ω": "w", "–": "-", "—": "-", "−": "-", "•": "*", "‘": "'", "’": "'"}
OTHERS |= dict(zip("▁▂▃▄▅▆▇█", "_.:-=+*#", strict=True))  # heights
OTHERS |= {"“": '"', "”": '"', "≤": "<=", "≥": ">=", "→": "->", "·": "*", "✓": "x"}
TITLE = 90  # characters for which a figure has room
STRAIGHT = {"HORIZONTAL": "-", "LEFT": "-", "RIGHT": "-", "VERTICAL": "|"}  # ends of names of box drawings


def showable(text: str, encoding: str) -> str:
    """Text in the characters of an encoding, so that columns keep their widths when it is written."""
    if encoding.startswith("utf"):
        return text
    return text.encode(encoding, HANDLER).decode(encoding)


def verbatim(text: str, most: int | None = None) -> str:
    """A user's text for a figure: dollars are escaped, lines stay, and the middle of a long text is left out."""
    if most is not None and len(text) > most:
        text = f"{text[: most // 2]}...{text[-(most // 2) :]}"
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text).replace("$", r"\$")


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(_in_ascii, error.object[error.start : error.end])), error.end


codecs.register_error(HANDLER, _replace)


def _in_ascii(character: str) -> str:
    if character in OTHERS:
        return OTHERS[character]
    name = unicodedata.name(character, "")
    if name.startswith("BOX DRAWINGS"):
        return "+" if " AND " in name else STRAIGHT.get(name.split()[-1], "+")
    if name.startswith("BRAILLE"):  # of what turns beside a line that takes its time
        return "."
    return unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode() or "?"


BEST = "bold green"  # style of rows that win
RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
INTERVAL = re.compile(r"(\S+) (\[\S+, \S+\]|±\S+)")
MANY = 9  # columns of a table that is set small on paper
FOLDED = 4  # columns from which a row is folded on a phone

console = Console(markup=False, highlight=False)


class WholeTable(RichTable):
    """A table whose title and caption use the width of the terminal rather than that of the table."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        title, caption = self.title, self.caption
        self.title = self.caption = None
        try:
            yield from [Text(str(title), style="table.title")] if title else []
            yield from super().__rich_console__(console, options)
            yield from [Text(str(caption), style="table.caption")] if caption else []
        finally:
            self.title, self.caption = title, caption


class Unfolded(str):
    """Text whose lines are not folded, as of a command to copy."""


class Table(NamedTuple):
    """A table of text: for the terminal (`print` of rich), a page, a notebook, Markdown and JSON.

    Attributes:
        title: above it, if it has one.
        columns: heads; empty for a list of names and what they are.
        rows: cells; the first one names the row, and is left-aligned.
        caption: below it.
        words: whether the other columns hold words, and are left-aligned, too; or the heads of those that do.
        best: numbers of rows that win, which stand out on a terminal; None is no row's number.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    words: bool | Sequence[str] = False
    best: Container[int | None] = ()

    def __rich__(self) -> RichTable:
        """The table for the terminal; where it is narrow, cells fold and no column is lost."""
        title, caption = (showable(part, console.encoding) for part in (self.title, self.caption))
        out = WholeTable(title=title, caption=caption, box=SIMPLE_HEAD)
        out.padding, out.pad_edge = (0, 1, 0, 0), False  # five figures with their intervals fit into 80 columns
        out.leading = int(any("\n" in str(cell) for row in self.rows for cell in row))
        words = () if isinstance(self.words, bool) else self.words
        for index, column in enumerate(self.columns):
            is_left = index == 0 or self.words is True or column in words
            justify: JustifyMethod = "left" if is_left else "right"
            head = Text(showable(column, console.encoding), overflow="fold")
            out.add_column(head, justify=justify, overflow="fold")
        for number, row in enumerate(self.rows):  # Text: units in brackets are no markup
            cells = [
                cell if isinstance(cell, Text) else Text(showable(str(cell), console.encoding)) for cell in row
            ]
            out.add_row(*cells, style=BEST if number in self.best else None)
        _keep_words_whole(out)
        return out

    def html(self) -> str:
        """The table for a page or a notebook; a page folds many columns on a phone, or lets them scroll."""
        head = "".join(f'<th scope="col">{typeset_html(column)}</th>' for column in self.columns)
        rows = "\n".join(
            f'<tr><th scope="row">{typeset_html(row[0])}</th>{self._cells(row[1:])}</tr>' for row in self.rows
        )
        head = f"<thead><tr>{head}</tr></thead>\n" if head else ""
        kind, label = ("", typeset_html(self.title)) if self.columns else (' class="words"', "a list")
        if len(self.columns) >= MANY:
            kind = ' class="many fold"'
        elif len(self.columns) >= FOLDED:
            kind = ' class="fold"'
        title = f'<p class="caption">{typeset_html(self.title)}</p>\n' if self.title else ""
        below = f"\n<p>{typeset_html(self.caption)}</p>" if self.caption else ""
        scroll = f'<div class="scroll" role="region" aria-label="{label}" tabindex="0">'
        return f"{title}{scroll}<table{kind}>\n{head}<tbody>\n{rows}\n</tbody></table></div>{below}"

    def _cells(self, cells: Sequence[Any]) -> str:
        """Cells of a row, each with the head of its column if there is one, for a folded row."""
        heads = self.columns[1:] if len(self.columns) >= FOLDED else ("",) * len(cells)
        return "".join(_cell(str(cell), head) for cell, head in zip(cells, heads, strict=True))

    def markdown(self) -> str:
        """The table in Markdown, its title above and its caption below."""
        columns = self.columns or ("",) * len(self.rows[0])
        lines = [_line(columns), _line(["---", *["---:"] * (len(columns) - 1)]), *map(_line, self.rows)]
        title = [f"**{markdown_text(self.title)}**", ""] if self.title else []
        below = ["", markdown_text(self.caption)] if self.caption else []
        return "\n".join([*title, *lines, *below])

    def on_page(self) -> str:
        """Heads and rows as a page of the docs has them, in Markdown that its script wrote."""
        return markdown_table(self.columns, self.rows)

    def as_dict(self) -> dict[str, Any]:
        """The texts, for JSON."""
        rows = [[str(cell) for cell in row] for row in self.rows]
        return {"title": self.title, "columns": list(self.columns), "rows": rows, "caption": self.caption}


def _cell(text: str, head: str = "") -> str:
    """A cell of a page; the interval of a value stands below it, and the head of its column is kept with it."""
    match = INTERVAL.fullmatch(text)
    value, below = (match[1], f"<small>{escape(match[2])}</small>") if match else (text, "")
    named = f' data-head="{typeset_html(head)}"' if head else ""
    return f"<td{named}>{typeset_html(value)}{below}</td>"


def typeset(text: str) -> str:
    """Units in a text as pages have them: m^3/s is m³/s."""
    return re.sub(r"(?<=[A-Za-z)])\^(-?\d+)", lambda match: match[1].translate(RAISED), text)


def typeset_html(text: str) -> str:
    """Text of a page, its units typeset."""
    return escape(typeset(str(text)))


def _line(cells: Sequence[Any]) -> str:
    return "| " + " | ".join(markdown_text(str(cell)) for cell in cells) + " |"


def markdown_text(text: str) -> str:
    """Text that Markdown takes as it is."""
    text = re.sub(r"([\\|*_`<$~])", r"\\\1", " ".join(text.split()))
    text = text.replace("](", "\\](").replace("![", "!\\[").replace("&", "&amp;")
    return f"\\{text}" if text[:1] in ("#", ">") else text


def _keep_words_whole(out: RichTable) -> None:
    """Let cells fold between words only, if there is room for the longest one of each column.

    The rest of the line goes to the columns that lack least: numbers stay whole, sentences fold. rich itself would
    make a table with minimal widths wider than the terminal, and cut it.
    """
    columns = [[column.header, *column.cells] for column in out.columns]
    longest = [max((_longest_word(str(cell)) for cell in cells), default=1) for cells in columns]
    margins = 2 * len(longest)  # by padding, frame and gaps
    if sum(longest) + margins > console.width:
        out.padding, margins = 0, len(longest) + 1
    lines = [max((len(line) for cell in cells for line in str(cell).split("\n")), default=1) for cells in columns]
    spare = console.width - sum(longest) - margins
    if spare < 0:
        return
    if sum(lines) <= sum(longest) + spare:
        for column, width in zip(out.columns, longest, strict=True):
            column.min_width = width
        return
    columns = [[str(head).replace(" ", "\n"), *cells] for head, *cells in columns]  # heads fold before cells
    lines = [max(len(line) for cell in cells for line in str(cell).split("\n")) for cells in columns]
    lacking = sorted((line - word, index) for index, (line, word) in enumerate(zip(lines, longest, strict=True)))
    for later, (lack, index) in enumerate(lacking):
        extra = min(lack, spare // (len(lacking) - later))
        out.columns[index].width, spare = longest[index] + extra, spare - extra


def _longest_word(cell: str) -> int:
    """The length of the longest word of a cell; the first one of a line has its indentation."""
    lines = [line.rstrip() for line in cell.split("\n")]
    words = [
        [len(line) - len(line.lstrip()) + len(line.split()[0]), *map(len, line.split())] for line in lines if line
    ]
    return max((length for lengths in words for length in lengths), default=1)


def plain_text(parts: Iterable[RenderableType], width: int | None = None) -> str:
    """Tables and lines as the terminal shows them, without colours; another width may be given."""
    stream = StringIO()
    plain = Console(
        file=stream,
        width=width or console.width,
        color_system=None,
        force_jupyter=False,
        markup=False,
        highlight=False,
    )
    for part in parts:
        plain.print(part, soft_wrap=isinstance(part, Unfolded))
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()).strip("\n")
