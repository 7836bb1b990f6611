"""`thruster filters`: every filter with its numbers, in words that fit the terminal."""

import json
import sys

import pytest

from filters.registry import FILTERS, filter_type
from thruster_env.core.text_tables import console
from tuning.cli.filters import entry, first_sentence, fitted
from tuning.cli.main import main


@pytest.fixture
def thruster(monkeypatch, capsys):
    """Run the command in this process; returns exit code, standard output and standard error."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["thruster", *arguments])
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code or 0, *capsys.readouterr()

    return run


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


@pytest.mark.parametrize("name", FILTERS)
def test_what_is_said_of_a_filter_comes_from_its_class(name):
    kind, told = filter_type(name).filter_class, entry(name)
    assert told.covariance is kind.has_covariance
    assert told.ensemble is ("ensemble_size" in filter_type(name).numbers)
    assert 10 < len(told.about) < 120 and told.about.endswith(".")
    assert tuple(number.name for number in told.numbers) == filter_type(name).numbers
    for number in told.numbers:
        assert number.default == getattr(kind, number.name) and len(number.meaning) > 5


def test_the_list_goes_to_json(thruster):
    code, out, _ = thruster("filters", "--json", "-")
    told = {one["name"]: one for one in json.loads(out)["filters"]}
    assert code == 0 and list(told) == list(FILTERS)
    size, *others = told["enkf"]["numbers"]
    assert size["name"] == "ensemble_size" and size["default"] == 100 and len(others) == 7
    assert told["low-pass"]["covariance"] is False and told["low-pass"]["ensemble"] is False


def test_an_unknown_filter_is_one_line(thruster):
    code, _, err = thruster("filters", "none")
    assert code == 2 and "filter must be one of kf, " in err and err.count("\n") == 1


@pytest.mark.parametrize("command", ["tune", "evaluate"])
def test_help_says_where_filters_are_listed(thruster, command):
    code, out, _ = thruster(command, "--help")
    assert code == 0 and "thruster filters" in " ".join(out.replace("│", " ").split())


def test_a_sentence_ends_with_a_full_stop_and_a_space():
    assert first_sentence("One of 0.5 to\n    1.0, see `a.b`. Two.") == "One of 0.5 to 1.0, see `a.b`."
    assert first_sentence("no stop") == "no stop"


def test_equations_break_where_they_part_and_sentences_fill_the_width():
    text = "One two three\nfour.\n\n    update:  a = b,  c = d,  e\n             g = h\n\nAttributes:\n    x: y"
    lines = "One two three four.", "", "    update:  a = b,", "             c = d,  e", "             g = h"
    assert fitted(text, 23) == "\n".join(lines)


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
