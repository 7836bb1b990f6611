"""A study of somebody else's runs no code through the state that CMA-ES keeps in it."""

import pickle

import numpy as np
import optuna
import pytest

from tuning.search.trials import NEEDS, make_sampler, read_state


class Attack:
    """Makes a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return open, (str(self.marker), "w")


def test_a_trial_s_state_is_read_as_data_and_no_code_runs(tmp_path, monkeypatch):
    monkeypatch.setitem(NEEDS, "cma-es", (None, None))  # the package is not there yet where this matters
    marker = tmp_path / "marker"
    state = {"cma:optimizer:0": pickle.dumps(Attack(marker)).hex()}
    trial = optuna.trial.create_trial(value=1.0, system_attrs=state)
    sampler = make_sampler("cma-es", 0, 0, {})
    with pytest.raises(ValueError, match="must be that of an optimizer, but a trial's names .*open$"):
        sampler._restore_optimizer([trial])
    assert not marker.exists()
    assert sampler._restore_optimizer([optuna.trial.create_trial(value=1.0)]) is None


def test_arrays_are_read_and_what_is_damaged_is_one_clear_line():
    arrays = {"mean": np.arange(3.0), "n": np.float64(2.5), "transposed": np.eye(2).T}
    found = read_state(pickle.dumps(arrays).hex())
    assert found["n"] == 2.5 and (found["mean"] == arrays["mean"]).all()
    for text in ("", "80", pickle.dumps(arrays).hex()[:-20], "no digits"):
        with pytest.raises(ValueError) as error:
            read_state(text)
        assert "\n" not in str(error.value)


def test_a_study_goes_on_as_with_optuna_s_own():
    pytest.importorskip("cmaes", reason="optional: an extra that tests do without")

    def values(sampler):
        study = optuna.create_study(sampler=sampler)
        study.optimize(lambda t: t.suggest_float("x", -5, 5) ** 2 + t.suggest_float("y", -5, 5) ** 2, n_trials=30)
        return [trial.value for trial in study.trials]

    ours = make_sampler("cma-es", 0, 0, {})
    seed = int(np.random.SeedSequence([0, 0, 0]).generate_state(1)[0])
    assert values(ours) == values(optuna.samplers.CmaEsSampler(seed=seed))
