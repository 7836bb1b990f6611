"""Objects by "module:object", actions that wait for a package's import, and how to install optional packages.

It imports nothing that takes time: `import thruster_env` needs it. `python -m thruster_env.core.modules`,
from the checkout's folder, removes what an uninstalled copy of our packages left behind, folders without sources,
which would hide the checkout's; `make` does so after each installation.
"""

from __future__ import annotations

import importlib
import os
import shutil
import sys
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

SAFE_PATH = "PYTHONSAFEPATH"  # which Python reads as its option -P
OF_ONE_PACKAGE = {
    "parquet": "pyarrow",
    "units": "pint",
    "frames": "pandas",
    "samplers": "cmaes",
    "nuts": "nutpie",
    "torch": "torch",
}


def is_code(name) -> bool:
    """Whether a name is "module:object", code that only the user may run."""
    return isinstance(name, str) and ":" in name and not name.endswith(".toml")


def object_named(name: str, what: str):
    """The object of "module:object", whose module lies where Python looks or in the working folder.

    Args:
        name: of the object.
        what: it is, for messages, such as "problem".

    Raises:
        ValueError: if the module cannot be imported, or lacks the object.
    """
    module_name, _, path = name.partition(":")
    try:
        result = _executed(module_name, name, what)
        for part in path.split("."):
            result = getattr(result, part)
    except RuleBroken:
        raise
    except (ImportError, AttributeError, ValueError) as error:
        rule = f"{what} must be 'module:object' that can be imported"
        raise ValueError(f"{rule}, but {name!r} is not: {error}") from None
    except Exception as error:
        article = "an" if what[0] in "aeiou" else "a"
        rule = f"{article} {what}'s module must import"
        raise ValueError(f"{rule}, but {name!r} raised {error_line(error)}") from error
    return result


def _executed(module_name: str, name: str, what: str) -> ModuleType:
    """The module; an error of rule and value that its lines raise needs no words about imports."""
    try:
        with working_folder_last():
            return importlib.import_module(module_name)
    except ValueError as error:
        if not module_name:
            raise
        raise RuleBroken(f"{error} ({what} {name!r})") from error


class RuleBroken(ValueError):
    """An error that a user's module raised while it ran."""


def error_line(error: BaseException) -> str:
    """The kind and message of an error of a user's code, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


@contextmanager
def working_folder_last() -> Iterator[None]:
    """Within this context modules are also imported from the working folder, after all other folders.

    So the user's module is found, and the modules beside it that it imports, now or when it is called; but a
    `struct.py` beside the data replaces no module of Python, of this package or of another one.
    """
    folder = os.getcwd()
    if folder in sys.path or "" in sys.path:
        yield
        return
    _USER_FOLDERS.folders.add(folder)
    if _USER_FOLDERS not in sys.meta_path:
        sys.meta_path.append(_USER_FOLDERS)  # after all others
    _USER_FOLDERS.open.append(folder)
    try:
        yield
    finally:
        _USER_FOLDERS.open.pop()


class _UserFolders:
    """Finds modules in a user's folder: within `working_folder_last`, and later for modules of the same folder."""

    def __init__(self):
        self.folders: set[str] = set()
        self.open: list[str] = []

    def find_spec(self, name: str, path=None, target=None) -> ModuleSpec | None:
        """The spec of a module in the working folder, if it may be imported from there."""
        if path is not None:
            return None
        if self.open:
            return PathFinder.find_spec(name, self.open[-1:])
        frame: FrameType | None = sys._getframe(1)
        while frame is not None and frame.f_globals.get("__name__", "").startswith("importlib."):
            frame = frame.f_back
        folder = None if frame is None else _folder_of(frame.f_globals.get("__name__", ""))
        return PathFinder.find_spec(name, [folder]) if folder is not None and folder in self.folders else None


_USER_FOLDERS = _UserFolders()


def _folder_of(name: str) -> str | None:
    file = getattr(sys.modules.get(name.partition(".")[0]), "__file__", None)
    if not file:
        return None
    folder, base = os.path.split(os.path.abspath(file))
    return os.path.dirname(folder) if base.startswith("__init__.") else folder


@contextmanager
def safe_paths() -> Iterator[None]:
    """Within this context new processes do not search the working folder for modules first."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


def when_imported(package: str, act: Callable[[], None]) -> None:
    """Call `act` once a package has been imported: at the end of its import, or now if it is there."""
    if package in sys.modules:
        act()
    else:
        sys.meta_path.insert(0, _Import(package, act))  # before all others: the last one calls the first


class AtFirstUse(ModuleType):
    """A module that is imported at the first use of one of its names: `np = AtFirstUse("numpy")`."""

    def __getattr__(self, name: str) -> Any:
        module = importlib.import_module(self.__name__)
        vars(self).update(vars(module))
        return getattr(module, name)


class _Import:
    """Watches for the import of a package."""

    def __init__(self, package: str, act: Callable[[], None]):
        self._package, self._act = package, act

    def find_spec(self, name: str, path=None, target=None) -> ModuleSpec | None:
        """The spec as the later finders give it, whose loader then calls `act`.

        It watches on until an import has succeeded: who asks for a spec need not import, and an import may fail.
        """
        if name != self._package:
            return None
        later = sys.meta_path[sys.meta_path.index(self) + 1 :]
        specs = (finder.find_spec(name, path, target) for finder in later)
        spec = next((spec for spec in specs if spec is not None), None)
        loader: Any = spec and spec.loader
        if loader is not None:
            execute = loader.exec_module

            def execute_and_act(module: ModuleType) -> None:
                execute(module)
                if self in sys.meta_path:  # a loader may have been wrapped twice
                    sys.meta_path.remove(self)
                    self._act()

            loader.exec_module = execute_and_act
        return spec


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


def remove_leftovers(site: Path, checkout: Path) -> list[Path]:
    """Remove folders in `site` with the name of a package in `checkout` that hold caches alone; return them.

    Args:
        site: folder where pip installs packages.
        checkout: folder of the sources.
    """
    removed = []
    for source in sorted(checkout.glob("*/__init__.py")):
        folder = site / source.parent.name
        files = [path for path in folder.rglob("*") if path.is_file()] if folder.is_dir() else []
        if folder.is_dir() and all(file.parent.name == "__pycache__" for file in files):
            shutil.rmtree(folder)
            removed.append(folder)
    return removed


def tidy() -> None:
    """Remove the leftovers of this environment, for the Makefile, which runs in the checkout."""
    for folder in remove_leftovers(Path(sysconfig.get_path("purelib")), Path.cwd()):
        print(f"removed {folder}, which an earlier installation left behind")
