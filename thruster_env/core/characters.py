"""Characters that a terminal lacks, in others that it has: no table ends in its middle."""

from __future__ import annotations

import codecs
import sys
import unicodedata

HANDLER = "thruster: other characters"  # name among Python's error handlers of encodings
OTHERS = {"±": "+-", "×": "x", "µ": "u", "ω": "w", "–": "-", "—": "-", "−": "-", "•": "*", "‘": "'", "’": "'"}
OTHERS |= dict(zip("▁▂▃▄▅▆▇█", "_.:-=+*#", strict=True))  # heights
OTHERS |= {"“": '"', "”": '"', "≤": "<=", "≥": ">=", "→": "->", "·": "*", "✓": "x"}
TITLE = 90  # characters for which a figure has room
STRAIGHT = {"HORIZONTAL": "-", "LEFT": "-", "RIGHT": "-", "VERTICAL": "|"}  # ends of names of box drawings


def adapt_standard_streams() -> None:
    """Have standard output and error write what their encoding lacks in other characters."""
    codecs.register_error(HANDLER, _replace)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors=HANDLER)


def showable(text: str, encoding: str) -> str:
    """Text in characters of an encoding, for what is laid out in columns before it is written."""
    if encoding.startswith("utf"):
        return text
    codecs.register_error(HANDLER, _replace)
    return text.encode(encoding, HANDLER).decode(encoding)


def verbatim(text: str, most: int | None = None) -> str:
    """Text of a user's for a figure: dollars begin no formula, and the middle of a long one is left out."""
    if most is not None and len(text) > most:
        text = f"{text[: most // 2]}...{text[-(most // 2) :]}"
    return "".join(one if one.isprintable() else "?" for one in text).replace("$", r"\$")


def _replace(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(_in_ascii, error.object[error.start : error.end])), error.end


def _in_ascii(character: str) -> str:
    if character in OTHERS:
        return OTHERS[character]
    name = unicodedata.name(character, "")
    if name.startswith("BOX DRAWINGS"):
        return "+" if " AND " in name else STRAIGHT.get(name.split()[-1], "+")
    if name.startswith("BRAILLE"):  # of what turns beside a line that takes its time
        return "."
    return unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode() or "?"
