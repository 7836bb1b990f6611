"""What is packed: every extra that is named exists, and a source distribution holds what its tests need."""

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import requires
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.repository.test_house import FLOORS
from thruster_env import __version__
from tuning.search.trials import NEEDS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {
    extra: {re.split(r"[<>=]", line)[0] for line in lines}
    for extra, lines in PROJECT["optional-dependencies"].items()
}
PINNED = {line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line}
LARGEST_WHEEL = 1_460_000  # bytes; less each time that the house shrinks
NOT_PACKED = {".gitignore", ".ci/run"}


def named_extras(text):
    return {extra for some in re.findall(r"(?:thruster-env|\.)\[([a-z,]+)\]'", text) for extra in some.split(",")}


def test_every_extra_that_is_named_exists():
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    sources = [path for package in FLOORS for path in (ROOT / package).rglob("*.py")]
    named = {extra for path in [*pages, *sources] for extra in named_extras(path.read_text())}
    assert {"rl", "db"} <= named <= set(EXTRAS)
    for package, extra in NEEDS.values():
        assert package in EXTRAS[extra]


def test_make_test_installs_every_package_that_a_test_may_need_in_a_pinned_version():
    listed = re.search(r"^TEST_EXTRAS := (.*)$", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1]
    assert set(EXTRAS) - set(listed.split(",")) == {"bench", "docs"}
    wanted = {name.lower().replace("-", "_") for names in EXTRAS.values() for name in names}
    assert wanted <= {name.lower().replace("-", "_") for name in PINNED}


def test_whatever_of_rl_zoo3_imports_requests_is_brought_by_the_extra():
    if find_spec("rl_zoo3") is None:  # importing it would change Gymnasium's TimeLimit for all tests
        pytest.skip("rl_zoo3 is not installed")
    theirs = {re.split(r"[^\w-]", line)[0] for line in requires("rl_zoo3")}
    assert "requests" in EXTRAS["peers"] or "requests" in theirs


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
