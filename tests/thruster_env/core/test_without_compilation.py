"""NUMBA_DISABLE_JIT, with which everything runs as Python."""

import runpy

import pytest

import thruster_env.core.compiled


@pytest.mark.parametrize("value, runs_as_python", [("1", True), ("0", False), ("", False)])
def test_the_environment_variable_of_numba_leaves_functions_as_they_are(value, runs_as_python, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", value)
    found = runpy.run_path(thruster_env.core.compiled.__file__)
    assert found["is_interpreting"]() == runs_as_python
