"""A tuned file carries its monitor: counts above those of the training runs, and thresholds for other readers."""

import json
import math

import numpy as np
import pytest

from filters.monitoring import Monitor, monitor_for, tuned_monitor
from tests.tuned_files import rewrite, write_untuned
from tuning.evaluation.tuned import monitor_data

NAN = math.nan


def test_counts_are_above_twice_the_longest_run_of_healthy_ones():
    coarse = np.array([0.0] * 7 + [1.0] * 3 + [2.0] * 9 + [1.0] * 2)
    slow = np.where(np.arange(21) % 8 == 0, np.arange(21.0), NAN)
    run = np.column_stack([coarse, slow])
    over = np.full((9, 2), NAN)  # the run is over
    found = monitor_for(np.array([np.vstack([run, over])]))
    assert (found.stuck, found.missing) == (2 * 9 + 1, 2 * 7 + 1)
    assert monitor_for(np.random.default_rng(0).normal(size=(2, 50, 1))) == Monitor()
    assert monitor_for(np.full((1, 5, 1), NAN)).missing == 10
    kept = monitor_for(np.array([run]), Monitor(steps_between=500.0, stuck=100))
    assert (kept.steps_between, kept.stuck) == (500.0, 100)


def test_thresholds_are_those_of_the_monitor_by_test():
    told = monitor_data(Monitor(), channels=2)["thresholds"]
    assert math.exp(-0.5 * told["outlier"][1]) == pytest.approx(1.0 / 400_000)  # chi^2 of two degrees of freedom
    assert told["glr"] > told["outlier"][0] ** 0.5 > 4.0 and told["cusum"] > 4.0
    assert told["variance"][0] < 50 < told["variance"][1]
    assert (told["stuck"], told["missing"]) == (10, 10)


def test_the_file_has_it_and_older_ones_do_not(tmp_path):
    path = write_untuned(tmp_path / "tuned.json", "outliers")
    content = json.loads(path.read_text())["monitor"]
    assert tuned_monitor(path) == Monitor(stuck=content["stuck"], missing=content["missing"])
    assert content["thresholds"] == monitor_data(tuned_monitor(path), 1)["thresholds"]
    rewrite(path, lambda content: content["monitor"].update(steps_between=3))
    with pytest.raises(ValueError, match="steps_between must be from 100 to 1e12, but got 3 .in the tuned file"):
        tuned_monitor(path)
    rewrite(path, lambda content: content.update(monitor=[1]))
    with pytest.raises(ValueError, match="the monitor of a tuned file must be a mapping"):
        tuned_monitor(path)
    rewrite(path, lambda content: content.pop("monitor"))
    with pytest.raises(ValueError, match="must have a monitor .tune again, or give the steps., but"):
        tuned_monitor(path)
