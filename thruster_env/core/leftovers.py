"""What an uninstalled copy of our packages left behind: folders without sources, which would hide the checkout's.

`python -m thruster_env.core.leftovers`, from the checkout's folder, removes them; `make` does so after each
installation.
"""

from __future__ import annotations

import shutil
import sysconfig
from pathlib import Path


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


if __name__ == "__main__":
    for folder in remove_leftovers(Path(sysconfig.get_path("purelib")), Path.cwd()):
        print(f"removed {folder}, which an earlier installation left behind")
