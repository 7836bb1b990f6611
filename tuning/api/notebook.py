"""A line of progress in a notebook without ipywidgets, which rich needs there: one output, redrawn."""

from __future__ import annotations

import io
import re
from typing import Any

CONTROLS = re.compile(r"\x1b\[[^@-~]*[@-~]")  # cursor, colours and the like
ERASED = "\x1b[2K"


class NotebookLine(io.StringIO):
    """A file for a console of rich: the terminal's last line becomes a notebook's output."""

    def __init__(self) -> None:
        """Begin without an output; the first text makes one."""
        super().__init__()
        self._handle: Any = None
        self._line = ""

    def write(self, text: str) -> int:
        """Show the last line of a text, or nothing where lines were erased."""
        lines = [line.rstrip() for line in re.split(r"[\r\n]+", CONTROLS.sub("", text)) if line.strip()]
        if lines or ERASED in text:
            self._show(lines[-1] if lines else "")
        return len(text)

    def isatty(self) -> bool:
        """True: lines are redrawn."""
        return True

    def _show(self, line: str) -> None:
        from IPython.display import display

        if line == self._line:
            return
        self._line, content = line, {"text/plain": line}
        if self._handle is None:
            self._handle = display(content, raw=True, display_id=True)
        else:
            self._handle.update(content, raw=True)
