"""Folders without sources, which an uninstalled copy leaves, hide a checkout's packages until they are removed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from thruster_env.core.modules import remove_leftovers

ROOT = Path(__file__).parents[3]


# A package that is installed in place is found as setuptools has it: after all folders of sys.path.
IN_PLACE = """
import importlib.util, sys
class Finder:
    def find_spec(name, path=None, target=None):
        if name == "filters":
            init = {checkout!r} + "/filters/__init__.py"
            return importlib.util.spec_from_file_location(name, init, submodule_search_locations=[init[:-12]])
sys.path.append({site!r})
sys.meta_path.append(Finder)
import filters.belief
"""


def test_what_holds_caches_alone_is_removed_and_nothing_else(tmp_path):
    site, checkout = tmp_path / "site", tmp_path / "checkout"
    for name in ("filters", "tuning", "thruster_env"):
        (checkout / name).mkdir(parents=True)
        (checkout / name / "__init__.py").touch()
    (checkout / "filters" / "belief.py").touch()
    for left in ("filters/engine/__pycache__/belief.nbi", "tuning/own.py", "others/__pycache__/x.nbc"):
        (site / left).parent.mkdir(parents=True)
        (site / left).touch()

    def error():
        script = IN_PLACE.format(site=str(site), checkout=str(checkout))
        return subprocess.run([sys.executable, "-I", "-S", "-c", script], capture_output=True, text=True).stderr

    assert "No module named 'filters.belief'" in error()
    assert remove_leftovers(site, checkout) == [site / "filters"]
    assert not error() and (site / "tuning" / "own.py").is_file() and (site / "others").is_dir()
    assert remove_leftovers(site, checkout) == []


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_installs_again_where_a_copy_has_taken_the_place_of_the_checkout(tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    site = tmp_path / ".venv" / "lib" / "python3.12" / "site-packages"
    site.mkdir(parents=True)
    installed = site / "__editable__.thruster_env-0.2.0.pth"
    installed.touch()
    stamps = [tmp_path / ".venv" / name for name in (".made", ".base", ".docs")]
    for stamp in stamps:
        stamp.touch()

    def planned():
        environment = {key: value for key, value in os.environ.items() if not key.startswith("MAKE")}
        done = subprocess.run(
            ["make", "-n", "docs"], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "pip" not in planned()
    installed.unlink()  # as `pip install .` does
    again = planned()
    assert "--no-build-isolation -e" in again and "modules.tidy()" in again
