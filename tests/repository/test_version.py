"""The version stands in thruster_env/__init__.py, and everything else that tells it tells the same."""

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

from thruster_env import __version__

ROOT = Path(__file__).resolve().parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def read(name, pattern):
    """What the first line that matches has in its group."""
    return re.search(pattern, (ROOT / name).read_text(), flags=re.MULTILINE)[1]


def test_pyproject_takes_it_from_the_package():
    assert "version" not in PYPROJECT["project"]
    assert PYPROJECT["project"]["dynamic"] == ["version"]
    assert PYPROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "thruster_env.__version__"}


def test_it_is_a_literal_that_a_build_reads_without_importing_numpy():
    assert read("thruster_env/__init__.py", r'^__version__ = "(\d+\.\d+\.\d+(?:(?:a|b|rc)\d+)?)"$') == __version__


def test_what_is_installed_is_this_version():
    assert version("thruster-env") == __version__, "install it anew: pip install -e ."


def test_citation_and_changelog_tell_the_same():
    assert read("CITATION.cff", r"^version: (.*)$") == __version__
    assert read("CHANGELOG.md", r"^## \[(.*?)\] - (?:Unreleased|\d{4}-\d{2}-\d{2})$") == __version__
