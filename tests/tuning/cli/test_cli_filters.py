"""`thruster filters`: every filter with its numbers, in words that fit the terminal."""

import json

import pytest

from filters.registry import FILTERS, filter_type
from thruster_env.core.text_tables import console
from tuning.cli.filters import entry


@pytest.mark.parametrize("width", [80, 120])
def test_the_list_names_every_filter_and_number_and_fits_the_terminal(thruster, monkeypatch, width):
    monkeypatch.setattr(console, "width", width)
    code, out, _ = thruster("filters")
    assert code == 0 and "…" not in out
    assert max(map(len, out.splitlines())) <= width
    first_words = [line.split()[0] for line in out.splitlines() if line.split()]
    for name in FILTERS:
        assert name in first_words
        assert set(filter_type(name).numbers) <= set(first_words)
    assert out.split().count("ensemble_size") == 3  # of members, particles, and few: shared lines are told once


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("width", [80, 120])
def test_one_filter_is_shown_in_full(thruster, monkeypatch, name, width):
    monkeypatch.setattr(console, "width", width)
    code, out, _ = thruster("filters", name)
    assert code == 0
    assert max(map(len, out.splitlines())) <= width
    words = out.split()
    documentation = entry(name).documentation
    told = documentation.split("Attributes:")[0].split() + documentation.partition("Source:")[2].split()
    assert set(told) <= set(words)
    for number in entry(name).numbers:
        assert {number.name, str(number.default), *number.meaning.split()} <= set(words)


@pytest.mark.slow
def test_it_tells_which_filters_fit_a_problem_and_what_a_belief_takes(thruster):
    code, out, _ = thruster("filters", "--problem", "tuning.experiments.lorenz96:problem", "--json", "-")
    found = {one["name"]: one for one in json.loads(out)["filters"]}
    assert code == 0 and list(found) == list(FILTERS)
    assert "affine model" in found["kf"]["reason"] and found["kf"]["kilobytes"] is None
    assert found["etkf"]["reason"] == "" and found["etkf"]["ensemble_size"] == 30
    assert found["ekf"]["kilobytes"] > 8e-3 * 3 * 40**2 and found["pf"]["kilobytes"] > 8e-3 * 1000 * 40
    code, out, _ = thruster("filters", "ukf", "--problem", "nominal")
    assert code == 0 and "nominal: 2 states, 1 measurement, 1 input" in " ".join(out.split()) and "ekf" not in out
    code, _, err = thruster("filters", "--problem", "nowhere:problem")
    assert code == 2 and "must be 'module:object' that can be imported" in err
