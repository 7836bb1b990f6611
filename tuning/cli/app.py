"""The sub-commands of `thruster`, put together; a command's own module is imported when it is called."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Mapping, MutableMapping
from importlib.metadata import version
from inspect import cleandoc
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.panel import Panel
from rich.table import Table as RichTable
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

import tuning
from thruster_env.core.text_tables import console
from tuning.cli.interrupts import PrintedWhole

PANELS = {
    "First steps": ("demo", "inspect", "simulate", "filters", "new"),
    "Tune and evaluate a filter": (
        "fit",
        "tune",
        "explore",
        "methods",
        "evaluate",
        "report",
        "verify",
        "export",
        "compare",
    ),
    "Recorded logs": ("log", "identify", "bollard", "estimate"),
    "Policies and learned estimators": ("train", "score", "play", "train-estimator"),
    "Published results and long studies": ("reproduce",),
}
COMMANDS = {name: panel for panel, names in PANELS.items() for name in names}
BESIDE = {"methods": "filters", "score": "train"}  # commands in the file of another one
VERBS = {
    name for name in COMMANDS if name.replace("-", "_") in tuning.__all__
}  # made from the function of that name
MARKUP: Final = "markdown"
LOADING = "loading ..."
VERSION = "Print the version and exit."


class Command(TyperCommand):
    """A command whose help Ctrl-C does not cut."""

    def format_help(self, ctx, formatter) -> None:
        """Print the help."""
        with PrintedWhole():
            super().format_help(ctx, formatter)


class Group(TyperGroup):
    """A group of commands whose help Ctrl-C does not cut."""

    def format_help(self, ctx, formatter) -> None:
        """Print the help."""
        with PrintedWhole():
            super().format_help(ctx, formatter)


class LazyGroup(Group):
    """A group whose commands are imported when they are called; `names`, `listed` and `loaded` say which."""

    _listing = False

    def names(self) -> Mapping[str, Any]:
        """Names of the commands, in the order of the help."""
        raise NotImplementedError

    def listed(self, name: str) -> TyperCommand:
        """A command with its name, panel and help alone."""
        raise NotImplementedError

    def loaded(self, name: str) -> typer.Typer:
        """The app of a command."""
        raise NotImplementedError

    def list_commands(self, ctx) -> list[str]:
        """Names in the order of the help."""
        return list(self.names())

    @property
    def commands(self) -> MutableMapping[str, Any]:
        """All commands by name, as they are listed."""
        return {name: self.listed(name) for name in self.names()}

    @commands.setter
    def commands(self, commands: MutableMapping[str, Any]) -> None:
        self._made = commands

    def format_help(self, ctx, formatter) -> None:
        """List the commands without importing them, which takes a second."""
        self._listing = True
        try:
            super().format_help(ctx, formatter)
        finally:
            self._listing = False

    def get_command(self, ctx, name: str):
        """The command of a name, None if there is none."""
        if name not in self.names():
            return None
        if self._listing:
            return self.listed(name)
        if name not in self._made:
            self._made[name] = get_command(self.loaded(name))
            self._made[name].name = name
        return self._made[name]


class Commands(LazyGroup):
    """The group of commands, each of the module of its name: a `command`, or an `app` of further ones."""

    def names(self) -> Mapping[str, str]:
        """Names of the commands."""
        return COMMANDS

    def listed(self, name: str) -> TyperCommand:
        """A command with its name, panel and help alone, read from its file."""
        return listed(name)

    def format_help(self, ctx, formatter) -> None:
        """List the commands in panels: Typer's own first imports a reader of Markdown, which takes as long."""
        panels = {"Options": {"--version": VERSION, "--help": "Show this message and exit."}}
        panels |= {title: {name: str(listed(name).help) for name in names} for title, names in PANELS.items()}
        with PrintedWhole():
            console.print(f"\nUsage: thruster [OPTIONS] COMMAND [ARGS]...\n\n{self.help}\n")
            for title, entries in panels.items():
                rows = RichTable.grid(padding=(0, 2, 0, 0))
                rows.add_column(style="bold cyan", width=max(map(len, COMMANDS)))
                for name, text in entries.items():
                    rows.add_row(name, " ".join(text.partition("\n\n")[0].replace("`", "").split()))
                console.print(Panel(rows, title=title, title_align="left", border_style="dim"))

    def loaded(self, name: str) -> typer.Typer:
        """The app of a command's module, or of its function."""
        home, function = home_of(name)
        module = imported(home)
        return module.app if hasattr(module, "app") else app_of(getattr(module, function))


def app_of(function: Callable, **chosen: Any) -> typer.Typer:
    """The app of a verb's command; arguments that are chosen have no option."""
    alone = typer.Typer(add_completion=False, rich_markup_mode=MARKUP, pretty_exceptions_enable=False)
    alone.command(cls=Command)(imported("tuning.cli.verbs").command_of(function, **chosen))
    return alone


def home_of(name: str) -> tuple[str, str]:
    """The module of a command, and its function there."""
    function = name.replace("-", "_")
    if name in VERBS:
        return tuning.home_of(function), function
    return f"tuning.cli.{BESIDE.get(name, name)}", function if name in BESIDE else "command"


def listed(name: str) -> TyperCommand:
    """A command with its name, panel and help alone, read from its file."""
    home, function = home_of(name)
    file = Path(__file__).parents[2].joinpath(*home.split(".")).with_suffix(".py")
    source = file.read_text(encoding="utf-8")
    match = re.search(rf'^def {function}\(.*?"""(.*?)(?:\n\n    Args:|""")', source, re.DOTALL | re.MULTILINE)
    text = cleandoc(match[1]) if match else source.split('"""')[1].partition(": ")[2].capitalize()
    return TyperCommand(name, help=text, rich_help_panel=COMMANDS[name])


def imported(module: str):
    """A module; on a terminal a word stands there while it is imported, which takes up to a second."""
    if not sys.stderr.isatty():
        return importlib.import_module(module)
    sys.stderr.write(LOADING)
    sys.stderr.flush()
    try:
        return importlib.import_module(module)
    finally:
        sys.stderr.write("\r" + " " * len(LOADING) + "\r")
        sys.stderr.flush()


def _version(wanted: bool) -> None:
    if wanted:
        print(f"thruster-env {version('thruster-env')}")
        raise typer.Exit


app = typer.Typer(
    cls=Commands,
    help="A ship's bow thruster, the filters that estimate its hidden state, and tuning for these filters; "
    "both also work with your own model, env or log.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=MARKUP,
    pretty_exceptions_enable=False,
)


@app.callback()
def _callback(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help=VERSION)] = False,
) -> None:
    pass
