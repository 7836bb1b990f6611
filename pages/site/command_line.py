"""The page on the command line: what `thruster COMMAND --help` says, as one page."""

from __future__ import annotations

import re

import typer
from typer.cli import get_docs_for_click

PAGE = "reference/command_line"
KINDS = {
    "<path>": "FILE",
    "<list[Path]>": "FILE",
    "<str>": "TEXT",
    "<list[str]>": "TEXT",
    "<int>": "INTEGER",
    "<int range>": "INTEGER",
    "<float>": "NUMBER",
    "<float range>": "NUMBER",
    "<list[float]>": "NUMBER",
    "<float,float>...": "NUMBER NUMBER",
}
ITEM = re.compile(r"^\* `([^`<]+) (<[^`]+)`(: Folder)?", re.MULTILINE)
EXAMPLES = re.compile(r"^Example: thruster .*(?:\n\nExample: thruster .*)*$", re.MULTILINE)
SUMMARY = re.compile(r"^(\* `(\w+)`: ).*\.\.\.$", re.MULTILINE)
GIVEN_BY_NAME = re.compile(r"\[default: \(([^()]*)\)")


def commands() -> str:
    """All commands with their arguments and options, in Markdown.

    Examples stand in blocks that can be copied, and what an option takes is in capitals everywhere.
    """
    from tuning.cli.app import app

    command = typer.main.get_command(app)
    context = typer.Context(command, info_name="thruster")
    text = get_docs_for_click(obj=command, ctx=context, name="thruster", indent=1)
    helps = dict(_helps(command, context))
    text = SUMMARY.sub(lambda match: f"{match[1]}{helps[match[2]]}", text)
    text = EXAMPLES.sub(_copied, text)
    text = ITEM.sub(_in_capitals, text)
    return GIVEN_BY_NAME.sub(r"[default: \1", text)


def _helps(group, context: typer.Context):
    """Names of all commands, and what each does in one paragraph: typer itself cuts it after 45 letters."""
    for name in group.list_commands(context) if hasattr(group, "list_commands") else ():
        command = group.get_command(context, name)
        yield name, " ".join((command.help or "").split("\n\n")[0].split())
        yield from _helps(command, context)


def _copied(match: re.Match[str]) -> str:
    """Lines of examples as one block, as a shell has them."""
    lines = [line.removeprefix("Example: ") for line in match[0].split("\n\n")]
    return "\n".join(["```console", *(f"$ {line}" for line in lines), "```"])


def _in_capitals(match: re.Match[str]) -> str:
    """An option with what it takes, or an argument, without typer's name of the type."""
    name, kind, folder = match.groups(default="")
    metavar = f" {'FOLDER' if folder else KINDS[kind]}" if name.startswith("-") else ""
    return f"* `{name}{metavar}`{folder}"


def _append(app, name: str, source: list[str]) -> None:
    if name == PAGE:
        source[0] += "\n" + commands()


def setup(app) -> dict[str, bool]:
    """Read the commands where the page is read."""
    app.connect("source-read", _append)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
