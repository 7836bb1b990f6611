"""Where machine code is kept: beside the sources, in the user's cache, or, where both refuse it, a private folder.

Beside sources that pip installed nothing is kept: what pip does not know outlives an uninstallation, and a folder
of machine code alone is, to Python, a package that hides the one of a checkout.

numba itself gives up where it cannot write. Here what is there already is read, and what is new goes to a folder
of the user's own among the temporary ones, or lasts as long as the process; one warning says so.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import tempfile
import threading
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

RULE = "machine code must be kept where it can be written: set NUMBA_CACHE_DIR to a folder of yours; "
INSTALLED = {"site-packages", "dist-packages"}  # folders of what pip installs
_changing_config = threading.Lock()


def keep_code(dispatcher):
    """Give a dispatcher of numba's a cache that bears folders and disks which take nothing; return it."""
    from numba.core.caching import FunctionCache

    function = dispatcher.py_func
    try:
        dispatcher._cache = Stores(
            [], _elsewhere(function) if _is_installed(function) else FunctionCache(function)
        )
    except RuntimeError:  # "no locator available"
        folder = _told_folder()
        dispatcher._cache = Stores(_readable(function), folder and _in_folder(function, folder))
    return dispatcher


class Stores:
    """Caches of numba to read from, of which at most the last is written."""

    def __init__(self, readable: list, writable):
        """Take caches that are only read, and one that is written, or None."""
        self._readable, self._writable = [*readable, *([] if writable is None else [writable])], writable

    @property
    def cache_path(self) -> str | None:
        """Folder into which new code goes."""
        return None if self._writable is None else self._writable.cache_path

    def load_overload(self, signature, target):
        """The code for a signature, or None."""
        for store in self._readable:
            try:
                found = store.load_overload(signature, target)
            except Exception:  # another user's, or damaged in whatever way: as if it were not there
                continue
            if found is not None:
                return found
        return None

    def save_overload(self, signature, code) -> None:
        """Keep the code for a signature if that is possible."""
        if self._writable is None:
            return
        try:
            try:
                self._writable.save_overload(signature, code)
            except OSError:
                raise
            except Exception:  # the list of what there is is damaged
                self._writable.flush()
                self._writable.save_overload(signature, code)
        except OSError as error:
            _tell(f"{self.cache_path} does not take it ({error.strerror})")

    def enable(self) -> None:
        """As numba's caches have it."""

    disable = flush = enable


@cache
def made_by() -> str:
    """The versions and the processor for which machine code is made: others may compute other last digits."""
    import numba
    from numba.core.registry import cpu_target

    return f"{numba.__version__} {np.__version__} {cpu_target.target_context.codegen().magic_tuple()}"


@cache
def _tell(where: str) -> None:
    warnings.warn(f"{RULE}{where}", stacklevel=2)


@cache
def _told_folder() -> str | None:
    """The private folder, after a line that says so; None where there is none."""
    folder = private_folder()
    neither = "neither the package's folder nor the user's cache is such"
    _tell(f"{neither}; it is in {folder}" if folder else f"{neither}; each process compiles anew")
    return folder


def private_folder() -> str | None:
    """A folder among the temporary ones that nobody else can write, for what is loaded from it is run."""
    try:
        folder = Path(tempfile.gettempdir()) / f"thruster-env-{os.getuid() if hasattr(os, 'getuid') else 'code'}"
        try:
            folder.mkdir(mode=0o700)
        except FileExistsError:
            found = folder.lstat()
            own = not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o077)
            if not (stat.S_ISDIR(found.st_mode) and own):
                folder = Path(tempfile.mkdtemp(prefix="thruster-env-"))  # lasts as long as the process
                atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return str(folder)
    except OSError:
        return None


def _is_installed(function) -> bool:
    """Whether a function's file is among those that pip has installed, and will one day remove."""
    return not INSTALLED.isdisjoint(Path(function.__code__.co_filename).parts)


def _elsewhere(function):
    """The cache of a function where the user says, or in the user's folder; RuntimeError if neither takes it."""
    return _cache_by(function, [one for one in _locators() if not one.__name__.startswith("InTree")])


def _locators() -> list:
    """Where numba looks for a place, in its order."""
    from numba.core.caching import FunctionCache

    return list(FunctionCache._impl_class._locator_classes)


def _cache_by(function, locators: list):
    """The cache of a function in the first place of some that will have it."""
    from numba.core.caching import FunctionCache

    implementation = type("Placed", (FunctionCache._impl_class,), {"_locator_classes": locators})
    return type("PlacedCache", (FunctionCache,), {"_impl_class": implementation})(function)


def _in_folder(function, folder: str):
    """The cache of a function below a folder."""
    import numba
    from numba.core.caching import FunctionCache

    config: Any = numba.config  # a module that makes its settings when it is imported
    with _changing_config:
        before, config.CACHE_DIR = config.CACHE_DIR, folder
        try:
            return FunctionCache(function)
        except RuntimeError:  # the disk is full
            return None
        finally:
            config.CACHE_DIR = before


def _readable(function) -> list:
    """All caches of a function that are there, whether or not they can be written."""
    found = []
    for locator in _locators():
        reading = type(locator.__name__, (locator,), {"ensure_cache_path": _must_be_there})
        try:
            found.append(_cache_by(function, [reading]))
        except (RuntimeError, OSError, ImportError):  # not in such a place
            continue
    return found


def _must_be_there(locator) -> None:
    if not os.path.isdir(locator.get_cache_path()):
        raise FileNotFoundError
