"""`python -m tests.repository.types`: mypy's errors in each room, at most as many as types.toml allows.

A room that the file does not name may have none. A number there may only fall: `--write` stores the lower ones.
"""

import re
import sys
import tomllib
from pathlib import Path

STORED = Path(__file__).with_name("types.toml")
HEAD = "# Errors that mypy may find, by room; none in a room that is not here. A number may only fall.\n"


def errors_by_room(lines):
    """Lines of mypy's output that are errors, by the room that they are in."""
    found = {}
    for line in lines:
        if match := re.match(r"(\w+)[/\\].*: error: ", line):
            found.setdefault(match[1], []).append(line)
    return found


def complaints(found, allowed):
    """Every error of a room that has more than it is allowed, and a line that says so."""
    said = []
    for room, lines in sorted(found.items()):
        if len(lines) > (most := allowed.get(room, 0)):
            said += [*lines, f"{room}: mypy may find at most {most} errors, but found {len(lines)}"]
    return said


def lowered(found, allowed):
    """Numbers allowed from now on: no room has more than before."""
    fewer = {room: min(len(found.get(room, ())), most) for room, most in allowed.items()}
    return {room: number for room, number in fewer.items() if number}


def main(arguments):
    """Run mypy; exit code 1 where a room has more errors than it is allowed."""
    from mypy import api

    out, err, code = api.run([])
    if code > 1:  # not errors in types: mypy itself could not run
        print(out, err, sep="")
        return code
    allowed = tomllib.loads(STORED.read_text(encoding="utf-8"))
    found = errors_by_room(out.splitlines())
    said = complaints(found, allowed)
    print(*said, sep="\n", end="\n" if said else "")
    fewer = lowered(found, allowed)
    if "--write" in arguments:
        rows = "".join(f"{room} = {number}\n" for room, number in fewer.items())
        STORED.write_text(HEAD + rows, encoding="utf-8")
    elif not said:
        text = ", ".join(f"{room} {len(lines)}" for room, lines in sorted(found.items())) or "none"
        hint = "; fewer than allowed: run it with --write" if fewer != allowed else ""
        print(f"mypy's errors: {text}{hint}")
    return 1 if said else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
