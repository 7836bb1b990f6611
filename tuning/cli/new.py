"""`thruster new`: a file to start from, for a problem, a model, an env, a filter or a thruster of one's own."""

from __future__ import annotations

import keyword
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from thruster_env.core.checks import one_of
from thruster_env.core.files import write_whole
from tuning.api.markers import INPUT, Argument
from tuning.api.result import Printed
from tuning.cli.output import check_targets

TEMPLATES = Path(__file__).parent / "templates"
FILES = {kind: f"{kind}.py" for kind in ("problem", "model", "env", "filter")} | {"preset": "preset.toml"}
NAMED = "template"  # what a template calls itself
NEXT = {
    "problem": "thruster tune --problem {name}:problem --filter ekf --trials 50",
    "model": "python {file}; thruster estimate {name}.csv --model {name}:model --plot estimate.png",
    "env": "python {file}; thruster tune --problem {name}:problem --filter ekf --trials 50",
    "filter": "thruster compare --filter ekf --filter {name}:{cls} --scenario outliers",
    "preset": "thruster inspect --preset {file} --voltage 12",
}


def command(
    kind: Annotated[str, Argument(INPUT, metavar="KIND", choices=FILES)],
    name: Annotated[Path, Argument(INPUT, metavar="NAME")],
) -> Printed:
    """Write a commented, working template of a problem, model, env, filter or thruster of your own.

    problem: a plant that generates data and what filters assume of it, for tune, evaluate and compare. model: a
    state-space model, for estimate, tune --log and identify. env: a Gymnasium env with a filter around it.
    filter: a filter as in a textbook, for every --filter. preset: a thruster's parameters, for every --preset.

    Example: thruster new problem pendulum

    Args:
        kind: what it is:
        name: name of the new file, .py or, for a preset, .toml.
    """
    file = target(kind, name)
    check_targets((file,), None)
    text = (TEMPLATES / FILES[kind]).read_text(encoding="utf-8").replace(f"{NAMED}.toml", str(file))
    cls = file.stem.title().replace("_", "")  # of a filter
    write_whole(file, text.replace(NAMED.title(), cls).replace(NAMED, file.stem))
    following = NEXT[kind].format(name=file.stem, cls=cls, file=file if kind == "preset" else file.name)
    where = "" if kind == "preset" or file.parent == Path() else f", in {file.parent}"
    return Printed([f"wrote {file}", f"Try it{where}: {following}"], {"file": str(file), "next": following})


def target(kind: str, name: Path) -> Path:
    """The file for a template.

    Raises:
        ValueError: for an unknown kind, an existing file, or a name that Python could not import.
    """
    suffix = Path(FILES[one_of("what is new", kind, FILES)]).suffix
    if name.suffix not in ("", suffix):
        raise ValueError(f"a new {kind} must end in {suffix}, but got {str(name)!r}")
    file = name.with_suffix(suffix)
    if file.exists():
        raise ValueError(f"a new {kind} must not replace a file, but {file} is there")
    if suffix == ".py":
        if not file.stem.isidentifier() or keyword.iskeyword(file.stem):
            raise ValueError(f"a module must have a name of letters, digits and _, but got {file.stem!r}")
        if find_spec(file.stem) is not None:
            raise ValueError(f"a new module must not hide one that is installed, but got {file.stem!r}")
    return file
