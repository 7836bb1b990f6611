"""What is packed: every extra that is named exists, and a source distribution holds what its tests need."""

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from importlib.metadata import requires
from pathlib import Path

import pytest

from tuning.search.samplers import NEEDS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {
    extra: {re.split(r"[<>=]", line)[0] for line in lines}
    for extra, lines in PROJECT["optional-dependencies"].items()
}
PINNED = {line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line}
ROOMS = ("thruster_env", "auv_env", "filters", "tuning", "training", "studies", "thruster_cli")
NOT_PACKED = {".gitignore", ".ci/run"}


def named_extras(text):
    return {extra for some in re.findall(r"(?:thruster-env|\.)\[([a-z,]+)\]'", text) for extra in some.split(",")}


def test_every_extra_that_is_named_exists():
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    sources = [path for room in ROOMS for path in (ROOT / room).rglob("*.py")]
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
    pytest.importorskip("rl_zoo3")
    theirs = {re.split(r"[^\w-]", line)[0] for line in requires("rl_zoo3")}
    assert "requests" in EXTRAS["peers"] or "requests" in theirs


def test_a_source_distribution_holds_the_whole_repository(tmp_path):
    if not (ROOT / ".git").exists():
        pytest.skip("only where git knows what there is")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    files = {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, tmp_path / name)
    program = "import setuptools.build_meta as build; build.build_sdist('dist')"
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, check=True)
    (archive,) = (tmp_path / "dist").iterdir()
    with tarfile.open(archive) as packed:
        found = {name.partition("/")[2] for name in packed.getnames()}
    assert sorted(files - found) == sorted(NOT_PACKED)
