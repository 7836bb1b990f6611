"""`thruster reproduce`: repeat a published experiment, a standard problem or a long study, by name.

Each compares its results with published ones or with other methods, and says why they differ. They run in a
checkout of the project.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from inspect import signature
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from thruster_env.core.modules import to_install
from tuning.api.markers import PythonOnly
from tuning.api.result import Printed
from tuning.cli.app import LazyGroup, app_of, imported

PACKAGE = "tuning.experiments"


def experiments() -> Mapping[str, Any]:
    """All experiments by name; ValueError where the package lacks them."""
    if find_spec(PACKAGE) is None:
        raise ValueError(
            "experiments must be run in a checkout of the project, but this installation has none: "
            "pip install -e . in the project's folder"
        )
    return import_module(PACKAGE).EXPERIMENTS


def tables(name: Annotated[str, PythonOnly()]) -> Printed:
    """Compute the experiment's tables, as they stand on its page of the docs.

    Args:
        name: of the experiment.
    """
    module = import_module(f"{PACKAGE}.{experiments()[name].module}")
    texts = {label: make() for label, make in module.TABLES.items()}
    return Printed([f"{label}\n\n{text}" for label, text in texts.items()], {"tables": texts})


class Experiments(LazyGroup):
    """The experiments, each as a command."""

    def names(self) -> Mapping[str, Any]:
        """Names of the experiments."""
        return experiments()

    def listed(self, name: str) -> TyperCommand:
        """An experiment with its line alone."""
        return TyperCommand(name, help=experiments()[name].about)

    def loaded(self, name: str) -> typer.Typer:
        """The app of an experiment's function."""
        path = experiments()[name].command or f"{experiments()[name].module}:reproduce"
        module, _, function = path.partition(":")
        try:
            run = getattr(imported(f"{PACKAGE}.{module}"), function, tables)
        except ModuleNotFoundError as error:
            needed = f"{name} must have {error.name}, which is not installed: {to_install('rl')}"
            raise ValueError(needed) from None
        return app_of(run, **({"name": name} if "name" in signature(run).parameters else {}))


HELP = "Repeat a published experiment or a long study."
app = typer.Typer(cls=Experiments, help=HELP, no_args_is_help=True, add_completion=False)


@app.callback()
def _callback() -> None:
    pass
