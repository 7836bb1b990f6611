"""Equations of docstrings, in plain text, as LaTeX.

`x_{k+1} = f(x_k, u_k) + w,  w ~ N(0, Q)` reads well in a terminal, and it can be set: names of one letter and
Greek ones are variables, longer ones stand upright, `_` and `^` hold for what follows, ' is a prime.
"""

from __future__ import annotations

import re

GREEK = set(
    "alpha beta gamma delta epsilon theta kappa lambda mu nu xi pi rho sigma tau phi chi psi omega".split()
)
GREEK |= {"Gamma", "Delta", "Theta", "Lambda", "Phi", "Psi", "Omega"}
DIFFERENTIALS = {"df", "dh", "dx", "dt", "du"}
FUNCTIONS = {"atan": r"\arctan", "log": r"\log", "exp": r"\exp", "sin": r"\sin", "cos": r"\cos", "det": r"\det"}
GROUP = r"\((?:[^()]|\([^()]*\))*\)"
TOKEN = re.compile(
    rf"""(?P<space>\s+)
    |(?P<code>`[^`]+`)
    |(?P<power>\^(?:{GROUP}|\{{[^}}]*\}}|-?\w+(?:/\d+)?))
    |(?P<index>_(?:\{{[^}}]*\}}|[A-Za-z0-9]+))
    |(?P<word>[A-Za-z]+(?:-[a-z]+)*(?:'s\b)?\d*)
    |(?P<number>\d+(?:\.\d+)?(?:e-?\d+)?)
    |(?P<sign>\.\.\.|\+=|-=|\+-|<=|>=|.)""",
    re.VERBOSE,
)
SIGNS = {
    "...": r"\ldots ",
    "+=": "{+}{=}",
    "-=": "{-}{=}",
    "+-": r"\pm ",
    "<=": r"\le ",
    ">=": r"\ge ",
    "~": r"\sim ",
}
SIGNS |= {"%": r"\%", "{": r"\{", "}": r"\}", "&": r"\&", "#": r"\#", "_": r"\_", "|": r"\vert "}
SPACED = {"=", "+", "-", "<", ">", "~", "+=", "-=", "+-", "<=", ">="}  # mathematics has its own space around these
LABEL = re.compile(r"^(?P<label>[a-z_]+(?: [a-z]+|, [a-z]+)*):\s+(?P<rest>.*)$")


def latex_of(block: str) -> str:
    """Return the LaTeX of an equation in plain text of one or more lines, aligned as the text is.

    What stands before a colon at the beginning of a line ("predict: ...") becomes a column of its own.
    """
    rows = [line.rstrip() for line in block.splitlines() if line.strip()]
    labelled = any(LABEL.match(row) for row in rows)
    return r"\begin{aligned}" + r" \\ ".join(_row(row, labelled) for row in rows) + r"\end{aligned}"


def _row(line: str, labelled: bool) -> str:
    label = LABEL.match(line)
    if labelled and label:
        return rf"\text{{{_plain(label['label'])}:}} & {inline(label['rest'])}"
    indent = r"\quad " if line.startswith(" ") and not labelled else ""
    return f"& {indent}{inline(line.strip())}"


def inline(text: str) -> str:
    """Return the LaTeX of one line, without its alignment."""
    tokens = [(match.lastgroup, match.group()) for match in TOKEN.finditer(_without_roots(text))]
    latex = "".join(_set(tokens, index) for index in range(len(tokens)))
    # Words side by side are one text.
    latex = re.sub(r"(?<=\\text{)([^{}]*)}(?:\\ \\text{([^{}]*)})+", _joined, latex)
    return latex.replace("\x01", r"\sqrt{").replace("\x02", "}")


def _joined(match: re.Match) -> str:
    return match.group().replace(r"}\ \text{", " ")


def _without_roots(text: str) -> str:
    """Put marks in place of `sqrt(` and of the bracket that closes it."""
    while (start := text.find("sqrt(")) >= 0:
        depth, end = 1, start + 5
        while depth and end < len(text):
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
        text = f"{text[:start]}\x01{text[start + 5 : end - 1]}\x02{text[end:]}"
    return text


def _set(tokens: list[tuple[str, str]], index: int) -> str:
    kind, text = tokens[index]
    if kind == "word":
        return _name(tokens, index)
    if kind == "space":
        beside_sign = any(token in SPACED for _, token in tokens[index - 1 : index + 2])
        return (
            r"\quad " if len(text) > 1 else r"\ " if _near_words(tokens, index, any) and not beside_sign else " "
        )
    if kind == "code":
        return rf"\text{{{_plain(text[1:-1])}}}"
    if kind == "power":
        return f"^{{{inline(_unwrapped(text[1:]))}}}"
    if kind == "index":
        return f"_{{{_index(_unwrapped(text[1:]))}}}"
    if kind == "sign" and text == "'":
        after_word = index and _is_word(tokens, index - 1)
        return r"\text{’}" if after_word else "'"
    return SIGNS.get(text, text) if kind == "sign" else text


def _name(tokens: list[tuple[str, str]], index: int) -> str:
    """A variable, a function's name, or a word of English."""
    text = tokens[index][1]
    following = tokens[index + 1][1] if index + 1 < len(tokens) else ""
    letters = text.rstrip("0123456789")
    if text == "sum" and not _says(tokens, index + 1, "of", "over"):
        return r"\sum "
    if text == "N" and following == "(":
        return r"\mathcal{N}"
    if letters in GREEK or letters in DIFFERENTIALS or len(letters) == 1:
        if text in ("a", "I") and _near_words(tokens, index, all, step=2):
            return rf"\text{{{text}}}"
        base = f"\\{letters} " if letters in GREEK else letters
        return base + (f"_{{{text[len(letters) :]}}}" if text != letters else "")
    if text in FUNCTIONS:
        return FUNCTIONS[text] + " "
    return rf"\mathrm{{{text}}}" if following.startswith(("_", "(")) else rf"\text{{{text.replace(chr(39), '’')}}}"


def _says(tokens: list[tuple[str, str]], index: int, *words: str) -> bool:
    return any(text in words for _, text in tokens[index : index + 2])


def _is_word(tokens: list[tuple[str, str]], index: int) -> bool:
    if not 0 <= index < len(tokens) or tokens[index][0] not in ("word", "code"):
        return False
    text = tokens[index][1]
    return len(text) > 1 and text.rstrip("0123456789") not in GREEK | DIFFERENTIALS and not text[1:].isdigit()


def _near_words(tokens: list[tuple[str, str]], index: int, how, step: int = 1) -> bool:
    return how(_is_word(tokens, neighbour) for neighbour in (index - step, index + step))


def _index(text: str) -> str:
    """An index: letters are indices one by one, longer words (`new`, `old`, `ref`) stand upright."""
    if text.isalpha() and len(text) > 2 and text not in GREEK:
        return rf"\text{{{text}}}"
    return inline(text) if not (text.isalpha() and len(text) == 2 and text not in GREEK) else text


def _unwrapped(text: str) -> str:
    return text[1:-1] if text[:1] in "({" and text[-1:] in ")}" else text


def _plain(text: str) -> str:
    return re.sub(r"([_#%&{}])", r"\\\1", text)


# Mathematics as MathML, which every browser sets by itself: no script, no fonts, no network.


def _mathml(self, node, before: str = "", after: str = "", **options) -> None:
    from docutils import nodes
    from docutils.utils.math.latex2mathml import tex2mathml

    self.body += [before, tex2mathml(node.astext(), **options), after]
    raise nodes.SkipNode


def _block_node(self, node) -> None:
    _mathml(self, node, self.starttag(node, "div", CLASS="equation"), "</div>\n", as_block=True)


# Docstrings in the reference: indented equations are set, prose is escaped for reStructuredText.
#
# Those of envs are Markdown, as Gymnasium's are: their headings and tables become reStructuredText.


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
    """Set mathematics as "mathml", and read docstrings before napoleon, which reads the sections.

    What napoleon calls variables are attributes to everybody else.
    """
    app.add_html_math_renderer("mathml", inline_renderers=(_mathml, None), block_renderers=(_block_node, None))
    from sphinx.domains.python import PyObject

    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
    app.connect("autodoc-process-docstring", _process, priority=100)
    app.connect("autodoc-skip-member", _skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
