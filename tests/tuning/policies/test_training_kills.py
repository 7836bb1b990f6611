"""What a training that was killed leaves behind is cleared away or put back, and it goes on."""
# ruff: noqa: F811 - fixtures come by import and go by name

import os
import shutil

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from tests.fuzz.checkpoints import kill_training
from tests.learners import contents, copied, learn, setup_of, short_episodes, steps_of, trained  # noqa: F401 - some are fixtures
from tuning.policies.learn import mend
from tuning.policies.saved import BEST, CHECKPOINTS, FINAL, SETUP, find_saved


class Killed(BaseException):
    """Like SIGKILL, an end that nothing catches."""


def test_what_was_being_written_is_cleared_away_and_what_was_being_replaced_is_put_back(copied):
    before, saved = contents(copied), copied / BEST
    shutil.copytree(saved, copied / CHECKPOINTS / ".000000300.x1y2z3")
    shutil.copytree(saved, copied / ".final.gone")
    (copied / f".{SETUP}.abc").write_text("{")
    (copied / ".evaluations.npz").write_bytes(b"PK half")
    os.replace(saved, copied / ".best.old")
    mend(copied)
    assert contents(copied) == before
    shutil.copytree(saved, copied / ".best.old")
    (copied / ".best.old" / SETUP).write_text("of before")
    mend(copied)
    assert contents(copied) == before


def test_a_training_that_was_killed_before_its_setup_was_there_starts_anew(tmp_path):
    (tmp_path / f".{SETUP}.abc").write_text("{")
    assert learn(setup_of(steps=128), tmp_path).learnt == 128
    assert not list(tmp_path.rglob(".*"))


def test_a_folder_of_something_else_is_left_as_it_is(tmp_path):
    (tmp_path / ".best.old").write_text("mine")
    (tmp_path / "notes").write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="the folder must be new, empty or that of a training"):
        learn(setup_of(steps=128), tmp_path)
    assert contents(tmp_path) == before


def test_an_end_while_evaluations_are_written_leaves_those_of_before(copied, monkeypatch):
    before = (copied / "evaluations.npz").read_bytes()

    def half(path, **arrays):
        with open(f"{path}.npz".replace(".npz.npz", ".npz"), "wb") as stream:
            stream.write(b"PK")
        raise Killed

    longer = setup_of(steps=512)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(np, "savez", half)
        learn(longer, copied)
    assert (copied / "evaluations.npz").read_bytes() == before
    assert learn(longer, copied).steps == 512


def test_an_end_while_a_policy_is_removed_leaves_none_that_is_half_there(copied, monkeypatch):
    def half(path, **options):
        if path.exists():
            (path / "normalisation.pkl").unlink()
            raise Killed

    longer = setup_of(steps=512)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(shutil, "rmtree", half)
        learn(longer, copied)  # whose final policy becomes a checkpoint that is there already
    assert not (copied / FINAL).exists() and steps_of(find_saved(copied)) == 256
    assert learn(longer, copied).learnt == 256


@pytest.mark.slow
def test_a_training_that_is_killed_loses_no_more_than_the_steps_since_its_checkpoint(monkeypatch):
    monkeypatch.setattr("tests.fuzz.checkpoints.STEPS", 1024)
    monkeypatch.setattr("tests.fuzz.checkpoints.BETWEEN", 16)  # with 64 checkpoints
    assert kill_training(np.random.default_rng(0), 1, 600).startswith("1 kills")
