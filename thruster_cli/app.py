"""The sub-commands of `thruster`, put together; a command's own module is imported when it is called."""

from __future__ import annotations

import importlib

import typer
from typer.core import TyperGroup
from typer.main import get_command

COMMANDS = (
    *(
        "demo",
        "inspect",
        "simulate",
        "estimate",
        "identify",
        "tune",
        "evaluate",
        "report",
        "verify",
        "compare",
        "filters",
    ),
    *("reproduce", "train", "play", "score", "study"),
)
MARKUP = "markdown"


class Commands(TyperGroup):
    """The group of commands, each of the module of its name: a `command`, or an `app` of further ones."""

    def list_commands(self, ctx) -> list[str]:
        """Names in the order of the help."""
        return list(COMMANDS)

    @property
    def commands(self) -> dict:
        """All commands by name, their modules imported."""
        for name in COMMANDS:
            self.get_command(None, name)
        return self._made

    @commands.setter
    def commands(self, given: dict) -> None:
        self._made = given

    def get_command(self, ctx, name: str):
        """The command of a name, None if there is none."""
        if name in COMMANDS and name not in self._made:
            module = importlib.import_module(f"thruster_cli.{name}")
            alone = typer.Typer(add_completion=False, rich_markup_mode=MARKUP, pretty_exceptions_enable=False)
            if hasattr(module, "app"):
                alone = module.app
            else:
                alone.command(name)(module.command)
            self._made[name] = get_command(alone)
            self._made[name].name = name
        return self._made.get(name)


app = typer.Typer(
    cls=Commands,
    help="A ship's bow thruster, the filters that estimate its hidden state, and the tuning that makes them good.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=MARKUP,
    pretty_exceptions_enable=False,
)


@app.callback()
def _callback() -> None:
    pass
