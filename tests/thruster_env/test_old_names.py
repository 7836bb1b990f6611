"""Packages that a user's own files could hide: nothing hides them now, and their old names work."""

import subprocess
import sys

import pytest

OURS = ("numerics", "plants", "training", "studies")
OLD = """
import warnings
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    import filters
    from plants.logs.read import read_log
    import plants.logs.grid, numerics.streams, studies, training.observations
import thruster_env.plants.logs.grid, thruster_env.plants.logs.read as now, thruster_env.plants as plants_now
assert read_log is now.read_log and plants is plants_now and plants.logs.grid is plants_now.logs.grid
assert plants.__spec__.name == plants.__name__ == "thruster_env.plants"
said = [str(one.message) for one in told if one.category is FutureWarning]
assert said[0] == "plants is thruster_env.plants now; the old name will be removed in the next version", said
assert len(said) == 4, said
try:
    import plants.nothing
except ModuleNotFoundError as error:
    assert "plants.nothing" in str(error)
"""
USER = """
import numerics, plants, training, studies
import filters, tuning, thruster_env.training, thruster_env.studies, thruster_cli.app
from thruster_env.plants.observe import ObserveState
assert numerics.mine and plants.mine and training.mine and studies.mine
assert not hasattr(filters, "mine") and ObserveState
"""


def run(code, folder):
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)


def test_old_names_are_the_same_modules_with_a_warning(tmp_path):
    assert run(OLD, tmp_path).stderr == ""


@pytest.mark.slow
def test_files_of_a_user_with_such_names_hide_nothing(tmp_path):
    for name in OURS:
        (tmp_path / f"{name}.py").write_text("mine = True\n")
    assert run(USER, tmp_path).stderr == ""
    listed = subprocess.run([sys.executable, "-m", "thruster_cli", "filters"], cwd=tmp_path, capture_output=True)
    assert listed.returncode == 0, listed.stderr
