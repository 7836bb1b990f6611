"""The page on the command line: what `thruster COMMAND --help` says, as one page."""

from __future__ import annotations

import typer
from typer.cli import get_docs_for_click

PAGE = "reference/command_line"


def commands() -> str:
    """All commands with their arguments and options, in Markdown."""
    from thruster_cli.app import app

    command = typer.main.get_command(app)
    context = typer.Context(command, info_name="thruster")
    return get_docs_for_click(obj=command, ctx=context, name="thruster", indent=1)


def _append(app, name: str, source: list[str]) -> None:
    if name == PAGE:
        source[0] += "\n" + commands()


def setup(app) -> dict[str, bool]:
    """Read the commands where the page is read."""
    app.connect("source-read", _append)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
