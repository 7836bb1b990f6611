"""A study of a user's own estimator goes on only with the code that it was made with."""

import sys

import pytest

from tests.linear_problem import LinearProblem
from tuning.search.plan import Plan
from tuning.search.storage import open_storage
from tuning.search.study import open_study

CODE = """
import numpy as np
from tuning.problems.problem import Parameter

class Still:
    def __init__(self, model, gain):
        self.model, self.gain = model, gain

    def reset(self, key, z):
        self.mean = np.zeros(self.model.n)
        return self.mean, np.eye(self.model.n)

    def step(self, u, z):
        self.mean = self.mean + FACTOR * self.gain
        return self.mean, np.eye(self.model.n)

def make(model, gain=0.5):
    return Still(model, gain)

make.parameters = [Parameter("gain", 0.1, 1.0, default=0.5)]
"""


def plan_of(folder, factor, monkeypatch):
    """A plan with the estimator as its file says it; another folder, so that nobody remembers the one before."""
    (folder / str(factor)).mkdir()
    (folder / str(factor) / "of_somebody.py").write_text(CODE.replace("FACTOR", str(factor)))
    monkeypatch.syspath_prepend(str(folder / str(factor)))
    sys.modules.pop("of_somebody", None)
    return Plan("of_somebody:make", (LinearProblem(),))


def test_a_study_of_an_estimator_whose_code_changed_is_refused(tmp_path, monkeypatch):
    storage = open_storage(str(tmp_path / "studies.journal"))
    first = plan_of(tmp_path, 1.0, monkeypatch)
    open_study("mine", first, storage)
    assert open_study("mine", first, storage).user_attrs["identity"] == first.identity
    second = plan_of(tmp_path, 2.0, monkeypatch)
    with pytest.raises(ValueError, match="the code of of_somebody:make is not what 'mine' was made with"):
        open_study("mine", second, storage)
    sys.modules.pop("of_somebody", None)


def test_a_study_of_a_filter_has_the_identity_that_it_had():
    assert "estimators" not in Plan("kf", (LinearProblem(),)).identity
