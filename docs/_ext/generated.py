"""Generated pages: the command line's, operations, methods of tuning, and the tutorials of examples."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import import_module
from inspect import getdoc, signature
from weakref import WeakSet

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
OPERATIONS_PAGE = "reference/operations"
METHODS_PAGE = "appendix/methods"
ALGEBRA = {
    "operations": "Symmetry, angles, missing channels, quotients, numbers",
    "points": "Roots, sigma points, weights, densities",
    "members": "Means and covariances over an ensemble",
    "roots": "Inverses, triangles, blocks, factors U and D",
}
SHOWN_ONLY = ("ppo",)  # learns for a minute; its own test runs it with few steps


# What `thruster COMMAND --help` says, as one page.


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


# What a filter's page is written with, as tables.


def operations() -> str:
    """All functions that a page calls on its matrices, each with its first sentence, in Markdown."""
    return "\n".join(line for name, title in ALGEBRA.items() for line in _operations_of(name, title))


def _operations_of(name: str, title: str) -> Iterator[str]:
    module = import_module(f"filters.algebra.{name}")
    yield from ("", f"## {title}", "", f"`filters.algebra.{name}`", "", "| call | result |", "|---|---|")
    for public, function in vars(module).items():
        computed = getattr(function, "compute", function)  # of an `Operation`
        if (
            public.startswith("_")
            or getattr(computed, "__module__", None) != module.__name__
            or isinstance(computed, type)
        ):
            continue
        arguments = signature(computed).parameters
        if "slopes" in arguments or any(a.annotation is not a.empty for a in arguments.values()):
            continue  # a derivative, or what makes operations: no page calls these
        result = " ".join((getdoc(computed) or "").split("\n\n")[0].split()).replace("|", "\\|")
        yield f"| `{public}({', '.join(arguments)})` | {result} |"


# What `thruster methods` says, as a table.


def methods() -> str:
    """All methods of tuning, what they need, when to use which, and whose they are, in Markdown."""
    from tuning.methods.task import GRADIENT, METHODS, TRUTH

    needs = {TRUTH: "true states", GRADIENT: "a gradient"}
    lines = ["## Every method", "", "| method | what it does | needs | use it | source |", "|---|---|---|---|---|"]
    for name, method in METHODS.items():
        needed = ", ".join(text for need, text in needs.items() if need in method.needs)
        lines.append(f"| `{name}` | {method.about} | {needed} | {method.when} | {method.source} |")
    return "\n".join(lines)


def _append(app, name: str, source: list[str]) -> None:
    for page, generate in ((PAGE, commands), (OPERATIONS_PAGE, operations), (METHODS_PAGE, methods)):
        if name == page:
            source[0] += "\n" + generate()


def setup(app) -> dict[str, bool]:
    """Read the commands where the page is read."""
    app.connect("source-read", _append)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


# Tutorials, in the order in which one reads them. They run while the site is built.


ORDER = (
    "first_steps",
    "choose_a_filter",
    "tune",
    "own_model",
    "own_env",
    "own_log",
    "own_filter",
    "policies",
    "ppo",
    "vehicle",
    "networks",
)
_shown: WeakSet = WeakSet()


def in_order(name: str) -> int:
    """The place of a script, by its file name."""
    return ORDER.index(name.removesuffix(".py"))


def result_figures(block, block_vars: dict, gallery_conf: dict) -> str:
    """Save the `figure` of a block, as sphinx-gallery asks: what results plot is no figure of pyplot's."""
    from matplotlib.figure import Figure
    from sphinx_gallery.scrapers import figure_rst

    figure = block_vars["example_globals"].get("figure")
    if not isinstance(figure, Figure) or figure in _shown or figure.canvas.manager is not None:
        return ""  # those with a manager are pyplot's, which sphinx-gallery finds by itself
    _shown.add(figure)
    path = next(block_vars["image_path_iterator"])
    figure.savefig(path, bbox_inches="tight")
    return figure_rst([path], gallery_conf["src_dir"])
