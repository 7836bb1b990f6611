"""Attack everything at random for a while: `make fuzz`, or `python -m tests.fuzz --seconds 600 --seed 1`.

The seed is printed, and repeats a run as far as time allows: an attack ends when its share of the seconds is over.
Exit code 1 if anything crashed, hung, wrote a number that is not finite or met a user's mistake with a traceback.
"""

from __future__ import annotations

import importlib
import inspect
import os
import traceback
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer


def attacks() -> dict[str, Callable[[np.random.Generator, float], str]]:
    """All attacks by name, `file.function`; each takes a generator and seconds and returns what it did."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("[a-z]*.py")):
        module = importlib.import_module(f"tests.fuzz.{path.stem}")
        for name, value in vars(module).items():
            ours = inspect.isfunction(value) and value.__module__ == module.__name__
            if ours and list(inspect.signature(value).parameters) == ["rng", "seconds"]:
                found[f"{path.stem}.{name}"] = value
    return found


def command(
    seconds: Annotated[float, typer.Option(min=1, help="Time in all, shared out evenly; about.")] = 600.0,
    seed: Annotated[int | None, typer.Option(min=0, help="Of all attacks; by default a new one.")] = None,
    only: Annotated[str, typer.Option(help="Attacks whose name holds this.")] = "",
) -> None:
    """Attack everything at random for a while, and print for each attack what it did."""
    seed = int.from_bytes(os.urandom(4)) if seed is None else seed
    chosen = {name: attack for name, attack in attacks().items() if only in name}
    print(f"seed {seed}, {len(chosen)} attacks, {seconds:g} s in all", flush=True)
    broken = 0
    for name, attack in chosen.items():
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        try:
            line = attack(rng, seconds / len(chosen))
        except Exception:
            broken += 1
            line = f"BROKEN, of seed {seed}\n{traceback.format_exc()}"
        print(f"{name}: {line}", flush=True)
    print(f"{len(chosen) - broken} held, {broken} broken", flush=True)
    raise typer.Exit(int(broken > 0))


if __name__ == "__main__":
    typer.run(command)
