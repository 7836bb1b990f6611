"""How to install what is not in a plain installation: the optional dependencies of pyproject.toml."""

from __future__ import annotations

OF_ONE_PACKAGE = {
    "parquet": "pyarrow",
    "units": "pint",
    "frames": "pandas",
    "samplers": "cmaes",
    "nuts": "nutpie",
    "torch": "torch",
}


def to_install(extra: str) -> str:
    """The command that installs an extra, for the end of a message.

    An extra of one package is installed by that package's name. The others are named in this project's folder, for
    the project is on no package index.

    Args:
        extra: a key of `optional-dependencies` in pyproject.toml.
    """
    if extra in OF_ONE_PACKAGE:
        return f"pip install {OF_ONE_PACKAGE[extra]}"
    return f"pip install '.[{extra}]' in the project's folder"
