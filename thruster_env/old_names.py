"""Packages of ours by the names that they had before 0.2, when a user's `plants.py` could take their place.

A user's own file goes first; without one `import plants` is `thruster_env.plants`, with a warning.
"""

from __future__ import annotations

import importlib.util
import sys
import warnings
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

from thruster_env.numerics.compiled import WITHIN


class OldNames(MetaPathFinder, Loader):
    """Finds the module of today under its old name; there is one copy of it."""

    def find_spec(self, name: str, path=None, target=None) -> ModuleSpec | None:
        """The module, unless it is none of ours or somebody else has one of this name."""
        package, dot, _ = name.partition(".")
        now = f"thruster_env.{package}"
        if now not in WITHIN:
            return None
        if dot:
            ours = sys.modules.get(package) is sys.modules.get(now)
            return ModuleSpec(name, self) if ours and importlib.util.find_spec(f"thruster_env.{name}") else None
        others = (one.find_spec(name, path) for one in sys.meta_path if one is not self)
        return None if any(others) else ModuleSpec(name, self)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module by its name of today."""
        if "." not in spec.name:
            rule = f"{spec.name} is thruster_env.{spec.name} now; the old name will be removed in the next version"
            warnings.warn(rule, FutureWarning, stacklevel=2)
        module = importlib.import_module(f"thruster_env.{spec.name}")
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing is run again; what Python has just noted about the old name is taken back."""
        module.__spec__ = module.__spec__ and module.__spec__.loader_state


def keep_old_names() -> None:
    """Let old names be imported from now on; a second call does nothing."""
    if not any(isinstance(one, OldNames) for one in sys.meta_path):
        sys.meta_path.insert(0, OldNames())
