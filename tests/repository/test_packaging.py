"""What is packed, with which versions: pyproject.toml, constraints files, the CI file and the Makefile agree."""

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.repository.test_house import FLOORS
from thruster_env import __version__
from tuning.search.trials import NEEDS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {
    extra: {re.split(r"[<>=]", line)[0] for line in lines}
    for extra, lines in PROJECT["optional-dependencies"].items()
}
LARGEST_WHEEL = 1_518_000  # bytes; less each time that the house shrinks
NOT_PACKED = {".gitignore", ".ci/run"}
CI = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
MAKEFILE = (ROOT / "Makefile").read_text()
TESTED = re.search(r"^TEST_EXTRAS := (.*)$", MAKEFILE, flags=re.MULTILINE)[1].split(",")
NOT_OLDEST = {"torch"}  # constraints-oldest.txt says why


def pinned(name):
    lines = (ROOT / name).read_text().splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(package): Version(number) for package, number in pairs}


def required(extras):
    """Requirements of the package and of extras by name."""
    by_extra = PROJECT["optional-dependencies"]
    lines = [*PROJECT["dependencies"], *(line for extra in extras for line in by_extra[extra])]
    return {canonicalize_name(line.name): line for line in map(Requirement, lines)}


def named_extras(text):
    return {extra for some in re.findall(r"(?:thruster-env|\.)\[([a-z,]+)\]'", text) for extra in some.split(",")}


def test_every_extra_that_is_named_exists():
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    sources = [path for package in FLOORS for path in (ROOT / package).rglob("*.py")]
    named = {extra for path in [*pages, *sources] for extra in named_extras(path.read_text())}
    assert {"rl", "db"} <= named <= set(EXTRAS)
    for package, extra in NEEDS.values():
        assert package in EXTRAS[extra]


def test_pinned_versions_lie_within_the_ranges_and_the_oldest_are_their_lower_ends():
    assert set(EXTRAS) - set(TESTED) == {"bench", "docs", "cluster"}
    oldest, newest = pinned("constraints-oldest.txt"), pinned("constraints.txt")
    assert required(EXTRAS).keys() <= newest.keys()
    for name, requirement in required(TESTED).items():
        assert newest[name] in requirement.specifier, name
        if requirement.marker is None or requirement.marker.evaluate({"python_version": "3.11"}):
            (lowest,) = [Version(bound.version) for bound in requirement.specifier if bound.operator == ">="]
            assert oldest[name] in requirement.specifier, name
            assert (oldest[name] == lowest) == (name not in NOT_OLDEST), name


def test_the_ci_file_tries_every_python_and_makes_what_is_there():
    named = [line.rsplit(" ", 1)[1] for line in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", line)]
    tests = CI["jobs"]["tests"]["strategy"]["matrix"]
    assert named == tests["python"] and PROJECT["requires-python"] == f">={named[0]}"
    assert {"python": named[0], "versions": "oldest", "constraints": "constraints-oldest.txt"} in tests["include"]
    assert {"python": named[-1], "versions": "newest", "constraints": ""} in tests["include"]
    targets = set(re.findall(r"^([\w-]+):.*##", MAKEFILE, flags=re.MULTILINE))
    commands = [step.get("run", "") for job in CI["jobs"].values() for step in job["steps"]]
    words = [word for command in commands if command.startswith("make ") for word in command.split()[1:]]
    made = {word for word in words if not re.search("[={}]|constraints", word)}
    assert {"lint", "test", "test-slow", "docs"} <= made <= targets


def test_the_version_is_one_literal_that_everything_else_tells():
    def read(name, pattern):
        return re.search(pattern, (ROOT / name).read_text(), flags=re.MULTILINE)[1]

    assert PROJECT["dynamic"] == ["version"] and version("thruster-env") == __version__
    assert read("thruster_env/__init__.py", r'^__version__ = "(\d+\.\d+\.\d+(?:(?:a|b|rc)\d+)?)"$') == __version__
    assert read("CITATION.cff", r"^version: (.*)$") == __version__
    assert read("CHANGELOG.md", r"^## \[(.*?)\] - (?:Unreleased|\d{4}-\d{2}-\d{2})$") == __version__


def test_every_package_is_known_wherever_packages_are_listed():
    """Its folder is packed, its types and imports are checked, and what it warns of is an error."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    included = {name.removesuffix("*") for name in settings["setuptools"]["packages"]["find"]["include"]}
    warned = next(line for line in settings["pytest"]["ini_options"]["filterwarnings"] if line.startswith("error"))
    there = {path.parent.name for path in ROOT.glob("*/py.typed")}
    assert there == set(FLOORS) == included == set(settings["mypy"]["files"])
    assert there == set(re.search(r"\((.*?)\)", warned)[1].split("|"))


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """A folder with what git knows, and in dist/ a source distribution and a wheel built from it."""
    if not (ROOT / ".git").exists():
        pytest.skip("only where git knows what there is")
    folder = tmp_path_factory.mktemp("packed")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    files = {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)
    program = "import setuptools.build_meta as b; b.build_sdist('dist'); b.build_wheel('dist')"
    subprocess.run([sys.executable, "-c", program], cwd=folder, capture_output=True, check=True)
    return folder / "dist", files


@pytest.mark.slow
def test_a_source_distribution_holds_the_whole_repository(packed):
    dist, files = packed
    with tarfile.open(next(dist.glob("*.tar.gz"))) as archive:
        found = {name.partition("/")[2] for name in archive.getnames()}
    assert sorted(files - found) == sorted(NOT_PACKED)


def test_a_wheel_holds_every_file_of_every_package_but_experiments(packed):
    dist, files = packed
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
    of_packages = {
        name for name in files if name.partition("/")[0] in FLOORS and not name.startswith("tuning/experiments/")
    }
    assert {f"{package}/py.typed" for package in FLOORS} <= found
    assert sorted(found ^ of_packages) == []
    assert wheel.name.split("-")[:2] == ["thruster_env", __version__]
    assert wheel.stat().st_size < LARGEST_WHEEL


def test_make_installs_the_build_tool_that_the_package_asks_for():
    """A venv of Python 3.11 brings setuptools 65, which pip leaves as it is unless a version is named."""
    (wanted,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    command = ["make", "--dry-run", "--always-make", "CONSTRAINTS=", ".venv/.test"]
    lines = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    assert any(line.endswith(f"'{wanted}'") and " install " in line for line in lines)
