"""A disk that fills up while a policy learns: the training goes on when there is room."""

import errno

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from tests.learners import learn, setup_of, short_episodes  # noqa: E402, F401 - one is a fixture
from tuning.policies.saved import EVALUATIONS


def test_evaluations_that_find_no_room_do_not_spoil_those_before(tmp_path, monkeypatch):
    setup = setup_of("raw")
    savez, written = np.savez, []

    def full(path, **arrays):
        written.append(path)
        if len(written) == 2:
            with open(f"{path}.npz", "wb") as file:
                file.write(b"PK")
            raise OSError(errno.ENOSPC, "No space left on device")
        savez(path, **arrays)

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(OSError, match="No space left"):
            learn(setup, tmp_path / "p")
    with np.load(tmp_path / "p" / f"{EVALUATIONS}.npz") as kept:
        assert kept["timesteps"].tolist() == [128]
    trained = learn(setup, tmp_path / "p")
    assert [steps for steps, _ in trained.curve][0] == 128 and trained.steps >= 256
