"""How worker threads wait for the next call: whose word counts, and for how long."""

import os

import pytest

from thruster_env.core import parallel
from thruster_env.core.parallel import VARIABLE, waiting


@pytest.fixture(params=[None, "active", "passive"])
def inherited(request, monkeypatch):
    """A process that was started with this in its environment, and has not asked for it yet."""
    monkeypatch.setattr(parallel, "_policy", None)
    if request.param is None:
        monkeypatch.delenv(VARIABLE, raising=False)
    else:
        monkeypatch.setenv(VARIABLE, request.param)
    return request.param


def test_the_environment_counts_then_the_context_and_afterwards_all_is_as_it_was(inherited):
    usual = inherited or "active"
    with pytest.raises(KeyboardInterrupt), waiting("passive"):
        with waiting("active"):
            assert parallel.wait_policy() == "active"
        assert parallel.wait_policy() == "passive"
        raise KeyboardInterrupt
    assert parallel.wait_policy() == usual and os.environ.get(VARIABLE) == inherited


def test_an_error_within_the_context_is_not_hidden_by_a_variable_that_is_gone(inherited, monkeypatch):
    with pytest.raises(KeyboardInterrupt), waiting("passive"):
        monkeypatch.delenv(VARIABLE)
        raise KeyboardInterrupt
    assert os.environ.get(VARIABLE) == inherited


def test_a_process_that_is_started_within_the_context_waits_as_it_says(inherited, monkeypatch):
    with waiting("passive"):
        monkeypatch.setattr(parallel, "_policy", None)  # as it is in a new process, which has this environment
        assert parallel.wait_policy() == "passive"


def test_another_word_is_refused(monkeypatch):
    monkeypatch.setattr(parallel, "_policy", None)
    monkeypatch.setenv(VARIABLE, "pasive")
    with pytest.raises(ValueError, match=f"{VARIABLE} must be one of active, passive, but got 'pasive'; did you"):
        parallel.wait_policy()
    with pytest.raises(ValueError, match="policy must be one of active, passive, but got 0"), waiting(0):
        pass
