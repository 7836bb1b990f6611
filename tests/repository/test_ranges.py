"""What pyproject.toml says that it works with is what constraints files and the CI file try."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CI = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
MAKEFILE = (ROOT / "Makefile").read_text()
EXTRAS = re.search(r"^TEST_EXTRAS := (.*)$", MAKEFILE, flags=re.MULTILINE)[1].split(",")
PYTHON_OF_OLDEST = {"python_version": "3.11"}
NOT_OLDEST = {"torch"}  # constraints-oldest.txt says why


def pinned(name):
    lines = (ROOT / name).read_text().splitlines()
    pairs = [line.split("==") for line in lines if not line.startswith("#")]
    return {canonicalize_name(package): Version(version) for package, version in pairs}


OLDEST, PINNED = pinned("constraints-oldest.txt"), pinned("constraints.txt")
BY_EXTRA = PROJECT["optional-dependencies"]
WANTED = [*PROJECT["dependencies"], *(line for extra in EXTRAS for line in BY_EXTRA[extra])]
REQUIRED = {canonicalize_name(one.name): one for one in map(Requirement, WANTED)}
IN_OLDEST = {
    name: one for name, one in REQUIRED.items() if one.marker is None or one.marker.evaluate(PYTHON_OF_OLDEST)
}


def lowest(requirement):
    """The lower end of a range; a range without one would claim every version."""
    (bound,) = [one.version for one in requirement.specifier if one.operator == ">="]
    return Version(bound)


def test_the_oldest_versions_are_the_lower_ends_of_the_ranges():
    assert set(IN_OLDEST) <= set(OLDEST)
    differing = {name for name, one in IN_OLDEST.items() if OLDEST[name] != lowest(one)}
    assert differing == NOT_OLDEST


@pytest.mark.parametrize("versions", [OLDEST, PINNED], ids=["oldest", "pinned"])
def test_pinned_versions_lie_within_the_ranges(versions):
    known = [(one, versions[name]) for name, one in REQUIRED.items() if name in versions]
    assert known and not [str(one) for one, version in known if version not in one.specifier]


def test_the_ci_file_tries_every_python_that_the_classifiers_name():
    named = [line.rsplit(" ", 1)[1] for line in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", line)]
    tests = CI["jobs"]["tests"]["strategy"]["matrix"]
    assert named == tests["python"] and PROJECT["requires-python"] == f">={named[0]}"
    assert {"python": named[0], "versions": "oldest", "constraints": "constraints-oldest.txt"} in tests["include"]
    assert {"python": named[-1], "versions": "newest", "constraints": ""} in tests["include"]


def test_what_the_ci_file_makes_is_there():
    targets = set(re.findall(r"^([\w-]+):.*##", MAKEFILE, flags=re.MULTILINE))
    commands = [step.get("run", "") for job in CI["jobs"].values() for step in job["steps"]]
    words = [word for command in commands if command.startswith("make ") for word in command.split()[1:]]
    made = {word for word in words if not re.search("[={}]|constraints", word)}
    assert {"lint", "test", "test-slow", "docs"} <= made <= targets
