"""Filters by name, their numbers and colours, and the file that carries a tuned filter."""

import importlib.metadata
import json

import pytest

from filters import FILTERS, EnsembleKalmanFilter, ExtendedKalmanFilter, KalmanFilter, make_filter, thruster_model
from filters.logs.findings import STYLES, TRUTH, colour_of, plot_style
from filters.registry import filter_type
from filters.tuned_file import read_tuned_file, sealed
from filters.wrappers import PLANTS, plant_ids
from tests.filters.checks import refused
from tests.models import TUNED
from tuning.problems.problem import Parameter
from tuning.reporting.page import luminance, on_dark

NUMBERS = "must be made of finite numbers, but got"


def changed(**entries):
    return sealed({**TUNED, "filter": {**TUNED["filter"], **entries}})


def with_model(**entries):
    return changed(model={**TUNED["filter"]["model"], **entries})


@pytest.fixture
def write(tmp_path):
    def write(content):
        path = tmp_path / "tuned.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return write


def test_filters_go_by_their_names():
    known = {"kf": KalmanFilter, "ekf": ExtendedKalmanFilter, "enkf": EnsembleKalmanFilter}
    assert known.items() <= FILTERS.items()
    assert all(filter_type(name).filter_class is kind and kind.name == name for name, kind in FILTERS.items())


def test_a_filter_is_made_by_name_with_its_own_numbers():
    spread = "inflation", "relaxation", "adaptive_inflation", "inflation_by_state", "least_deviation"
    ensemble = "ensemble_size", *spread, "radius", "centred_perturbations"
    assert [filter_type(name).numbers for name in ("ekf", "enkf")] == [("form",), ensemble]
    made = make_filter("enkf", thruster_model(), ensemble_size=7)
    assert isinstance(made, EnsembleKalmanFilter)
    assert made.ensemble_size == made.size == 7


class Declaring:
    """An estimator with a parameter to tune, without a covariance."""

    has_covariance = False
    parameters = (Parameter("gain", 0.1, 1.0),)

    def __init__(self, model, gain=0.5):
        self.mean = model.prior_mean * gain

    def reset(self, key, z):
        return self.mean, None

    def step(self, u, z):
        return self.mean, None


def test_a_user_s_estimator_and_class_of_filters_go_by_their_objects():
    estimator, own = filter_type(Declaring), filter_type(EnsembleKalmanFilter)
    assert (estimator.is_estimator, estimator.numbers, estimator.label) == (True, ("gain",), "Declaring")
    assert (own.is_estimator, own.filter_class, own.has_ensemble) == (False, EnsembleKalmanFilter, True)
    assert estimator.is_foreign
    assert own.is_foreign
    assert not filter_type("enkf").is_foreign
    assert isinstance(estimator.make(thruster_model(), gain=0.1).estimator, Declaring)


def test_an_unknown_filter_is_refused_with_the_known_names():
    with pytest.raises(ValueError, match=r"filter must be one of kf, .*enkf, .* but got 'no filter'"):
        make_filter("no filter", thruster_model())


@pytest.mark.parametrize(("name", "number"), [("enkf", "size"), ("ekf", "ensemble_size")])
def test_an_unknown_number_is_refused(name, number):
    with pytest.raises(ValueError, match=f"a number of filter '{name}' must be one of .*but got '{number}'"):
        make_filter(name, thruster_model(), **{number: 3})


def test_a_tuned_file_is_read_as_it_was_written(write):
    assert read_tuned_file(write(TUNED)) == {**TUNED, "problem": None, "problems": {}}
    assert read_tuned_file(str(write(TUNED))) == {**TUNED, "problem": None, "problems": {}}


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        (json.dumps(TUNED)[:60], "whole JSON"),
        ("", "whole JSON"),
        ([TUNED], "format"),
        ({**TUNED, "format": "something else"}, "format"),
        ({**TUNED, "version": 5}, "version 2, 3 or 4, but .*tuned.json is of version 5: update thruster-env"),
        ({**TUNED, "version": 1}, "version 2, 3 or 4, but .*tuned.json is of version 1: tune again"),
        ({**TUNED, "version": [2]}, r"version 2, 3 or 4, but .*tuned.json is of version \[2\]$"),
        ({**TUNED, "version": True}, "version 2, 3 or 4, but .*tuned.json is of version True"),
        ({key: TUNED[key] for key in ("format", "filter")}, "version 2, 3 or 4, but .* is of version None"),
        ({**TUNED, "filter": {**TUNED["filter"], "name": "ekf"}}, f"was edited: its hash is '{TUNED['hash']}'"),
        ({**TUNED, "note": "mine"}, "was edited"),
        ({**TUNED, "hash": 3}, "with the hash of its content, but .*tuned.json was edited: its hash is 3"),
        ({key: TUNED[key] for key in ("format", "version", "filter")}, "was edited: its hash is None"),
        (sealed({key: TUNED[key] for key in ("format", "version")}), "name, numbers and model"),
        (sealed({**TUNED, "filter": {"name": "ekf"}}), "name, numbers and model"),
        (changed(name="no filter"), "one of kf, .*enkf, .* but got 'no filter'"),
        (changed(name=["enkf"]), "one of kf, .*enkf, .* but"),
        (changed(numbers=3), "numbers"),
        (changed(numbers=[20]), "numbers"),
        (changed(model=None), "model"),
        (
            changed(numbers={"size": 3}),
            "a number of filter 'enkf' must be one of ensemble_size, .* but got 'size'",
        ),
        (changed(numbers={"ensemble_size": "20"}), f"ensemble_size {NUMBERS} '20'"),
        (changed(numbers={"ensemble_size": True}), f"ensemble_size {NUMBERS} True"),
        (changed(numbers={"inflation": float("nan")}), "inflation must be a finite number, but got nan"),
        (
            with_model(model="os:system"),
            "an argument of the model of a tuned file must be one of .*but got 'model'",
        ),
        (with_model(operating_voltage=3.0), "an argument of the model .*, but got 'operating_voltage'"),
        (
            with_model(process_noise_cov=[1.0, float("inf")]),
            "process_noise_cov must be a finite number, but got inf",
        ),
        (with_model(process_noise_cov=[[[1.0]]]), "process_noise_cov must be made of finite numbers"),
        (with_model(process_noise_cov=[]), rf"process_noise_cov {NUMBERS} \[\]"),
        (with_model(measurement_noise_cov="1"), f"measurement_noise_cov {NUMBERS} '1'"),
        (with_model(measurement_noise_cov=None), "must have a measurement_noise_cov, but got"),
        (with_model(prior_cov_factor=0), "prior_cov_factor must be positive, but got 0"),
        (with_model(parameter_factors=[2.0]), "the parameter_factors of a tuned file must be a mapping"),
        (with_model(parameter_factors={"area": "2"}), "parameter_factors, area must be made of finite numbers"),
        (with_model(parameter_factors={"area": -2}), "parameter_factors, area must be positive, but got -2"),
        (sealed({**TUNED, "version": 3}), "the plant of a tuned file must be a mapping, but got None"),
        (sealed({**TUNED, "version": 3, "plant": {}, "scenarios": []}), "the scenarios of a tuned file must be"),
    ],
)
def test_a_damaged_tuned_file_is_refused_in_one_line(write, content, rule):
    refused(rule, read_tuned_file, write(content))


def test_the_hash_does_not_depend_on_order_and_layout(write):
    entries = reversed(TUNED.items())
    assert read_tuned_file(write(json.dumps(dict(entries), indent=7))) == {
        **TUNED,
        "problem": None,
        "problems": {},
    }
    assert sealed(TUNED) == TUNED


def test_a_tuned_file_that_is_not_there_is_refused(tmp_path):
    refused("must be readable.*nowhere.json", read_tuned_file, tmp_path / "nowhere.json")
    refused("must be readable", read_tuned_file, tmp_path)


def test_a_broken_package_of_plants_leaves_gymnasium_whole(monkeypatch):
    point = importlib.metadata.EntryPoint("broken", "package_that_is_missing", PLANTS)
    entry_points = importlib.metadata.entry_points
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [*entry_points(group=group), point])
    with pytest.warns(UserWarning, match="must import, but package_that_is_missing raised ModuleNotFoundError"):
        assert "BowThruster-v0" in plant_ids()


def test_every_filter_has_a_look_of_its_own():
    assert set(STYLES) == set(FILTERS)
    looks = [tuple(plot_style(name).values()) for name in (*FILTERS, "somebody:Estimator")]
    assert len(set(looks)) == len(looks)
    assert TRUTH["color"] not in {colour for colour, _ in looks}


def test_filters_that_are_drawn_together_differ_in_hue():
    for some in (
        ("kf", "ekf", "enkf", "ukf", "pf"),
        ("ekf", "iekf", "ukf", "ckf", "gsf"),
        ("enkf", "etkf", "denkf"),
    ):
        assert len({colour_of(name) for name in some}) == len(some)
    assert len({colour_of(name) for name in ("ekf", "open-loop", "low-pass", "inversion")}) == 4


def test_colours_are_legible_on_white_and_on_dark_paper():
    for colour, _ in STYLES.values():
        assert luminance(colour) < 0.45 and luminance(on_dark(colour)) > 0.2
