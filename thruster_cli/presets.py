"""`--preset` of commands on scenarios: the same scenario of another thruster."""

from __future__ import annotations

from typing import Annotated

import typer

from thruster_env.parameters import PRESETS
from tuning.thruster.logs import of_preset

__all__ = ["OfPresetOption", "of_preset"]

OfPresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset", help=f"The scenario of another thruster: {', '.join(PRESETS)}, or a FILE.toml of `identify`."
    ),
]
