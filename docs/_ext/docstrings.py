"""Docstrings in the reference: indented equations are set, prose is escaped for reStructuredText.

Those of envs are Markdown, as Gymnasium's are: their headings and tables become reStructuredText.
"""

from __future__ import annotations

import re

from docs._ext.equations import latex_of

PROSE_OR_CODE = re.compile(r"(``.+?``|`[^`]+`)", re.DOTALL)
MISREAD = re.compile(r"(\||\*(?! - ))|(?<=\w)(_)(?!\w)")

PYTHON = re.compile(r"^import |^\w+ = \w+\.|^\w+\.\w+\(", flags=re.MULTILINE)
CODE = re.compile(rf"{PYTHON.pattern}|^\[\w+\]$|\"|^thruster ", flags=re.MULTILINE)
NOT_OURS = ("Alias for field number", "dict() -> ")  # what namedtuple says of each field, and dict of itself


def readable(lines: list[str]) -> list[str]:
    """Return a docstring's lines with its equations and its code as directives, and its prose escaped."""
    out, prose, index = [], [], 0
    if any(line.startswith("## ") for line in lines):
        lines = _without_markdown(lines)
    while index < len(lines):
        after_blank = index > 1 and not lines[index - 1].strip() and not lines[index - 2].startswith(" ")
        if lines[index].startswith("    ") and after_blank:
            end = index
            while end < len(lines) and (lines[end].startswith("    ") or not lines[end].strip()):
                end += 1
            out += escaped(prose) + directive(lines[index:end])
            prose, index = [], end
        else:
            prose.append(lines[index])
            index += 1
    return out + escaped(prose)


def directive(block: list[str]) -> list[str]:
    """A block of equations as `math`; one of TOML or of commands as it stands."""
    text = "\n".join(line[4:] for line in block).rstrip()
    if not CODE.search(text):
        return [".. math::", "", f"    {latex_of(text)}", ""]
    language = "python" if PYTHON.search(text) else "text"
    return [f".. code-block:: {language}", "", *(f"    {line}" for line in text.splitlines()), ""]


def _without_markdown(lines: list[str]) -> list[str]:
    """Headings as rubrics, tables as tables; the rest is the same in both."""
    out: list[str] = []
    for number, line in enumerate(lines):
        if line.startswith("## "):
            out += [f".. rubric:: {line[3:]}", ""]
        elif re.fullmatch(r"[|: -]+", line) and "---" in line:
            continue
        elif line.startswith("|"):
            if number + 1 < len(lines) and lines[number + 1].startswith("|--"):
                out += [".. list-table::", "    :header-rows: 1", ""]
            cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
            out += [
                f"    {'- ' if column else '* - '}{cell}".replace("    - ", "      - ")
                for column, cell in enumerate(cells)
            ]
        else:
            out.append(line)
    return out


def escaped(lines: list[str]) -> list[str]:
    """Lines in which bars, asterisks and underscores at the end of a name are only what they are."""
    parts = PROSE_OR_CODE.split("\n".join(lines))
    parts[::2] = [MISREAD.sub(r"\\\g<0>", part) for part in parts[::2]]
    parts[2::2] = [rf"\ {part}" if part[:1].isalnum() else part for part in parts[2::2]]  # the plural of a name
    return "".join(parts).split("\n") if lines else []


def _process(app, what, name, obj, options, lines: list[str]) -> None:
    if lines and lines[0].startswith(NOT_OURS):
        lines[:] = [""]
    lines[:] = readable(lines)


def _skip(app, what, name, obj, skip: bool, options) -> bool | None:
    """Fields of named tuples stand in the list of attributes, with shapes and units."""
    return True if what == "class" and type(obj).__name__ == "_tuplegetter" else None


def setup(app) -> dict[str, bool]:
    """Come before napoleon, which reads the sections; what it calls variables are attributes to everybody else."""
    from sphinx.domains.python import PyObject

    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
    app.connect("autodoc-process-docstring", _process, priority=100)
    app.connect("autodoc-skip-member", _skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
