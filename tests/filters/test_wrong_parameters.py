"""Parameters that make no filter are refused in one line, with the rule and the value."""

import math

import pytest

from filters import FILTERS, make_filter
from filters.ensembles.ensemble import EnsembleFilter
from tests.filters.checks import refused
from tests.models import line_model, plane_model, state_space
from thruster_env.thruster.model import thruster_model

ADAPTS = {"adaptive_inflation": 0.3}
WHOLE = "must be a (whole|finite) number.* but got"
REFUSED = {  # by a filter's name: parameters, and the rule
    "kf": [
        ({"schedule": 0}, "schedule must be a whole number of at least 1, but got 0"),
        ({"schedule": 2.5}, "schedule must be a whole number of at least 1, but got 2.5"),
    ],
    "iekf": [({"iterations": value}, f"iterations {WHOLE}") for value in (0, -1, 1.5, math.nan, "many")]
    + [({"iterations": 21}, "iterations must be at most 20, but got 21")],
    "ukf": [
        ({"alpha": 0.0}, "alpha must be positive, but got 0"),
        ({"alpha": "wide"}, "alpha must be a finite number, but got 'wide'"),
        ({"beta": math.nan}, "beta must be a finite number"),
        ({"kappa": -2.0}, "kappa must be above minus the number of states, -2, but got -2.0"),
        ({"beta": -1.0}, "alpha.2 kappa . beta n must not be negative.* but got alpha=1.0, beta=-1.0"),
        ({"beta": 0.0, "kappa": -1.0}, "alpha.2 kappa . beta n must not be negative"),
    ],
    "mhe": [
        ({"horizon": 0}, "horizon must be"),
        ({"iterations": 51}, "iterations must be"),
        ({"threshold": 0.0}, "threshold must be"),
        ({"disturbance_limit": -1.0}, "disturbance_limit must be"),
        ({"loss": "cauchy"}, "loss must be one of huber, student, quadratic, but got 'cauchy'"),
    ],
    "fading": [({"fading": 0.9}, "fading must be")],
    "h-infinity": [
        ({"theta": 0.0}, "theta must be positive"),
        ({"scale": [1.0, 0.0]}, "scale must be positive"),
    ],
    "schmidt": [
        ({"considered": [2]}, "considered must be"),
        ({"considered": "last"}, "considered must be a list of indices, but got"),
    ],
    "enkf": [({"centred_perturbations": 2}, "centred_perturbations must be 0 or 1, but got 2")],
    "etkf": [
        ({"rotations": 2}, "rotations must be 0 or 1, but got 2"),
        ({"adaptive_inflation": -1}, "adaptive_inflation must be zero or positive, but got -1"),
        ({"inflation_by_state": 1}, "with inflation_by_state must be positive, but got 0"),
        ({**ADAPTS, "inflation_by_state": 2}, "inflation_by_state must be 0 or 1, but got 2"),
        (
            {**ADAPTS, "least_deviation": 0.4},
            "least_deviation must be at most adaptive_inflation, 0.3, but",
        ),
        ({**ADAPTS, "least_deviation": -1}, "least_deviation must be zero or positive, but got -1"),
    ],
    "ienkf": [({"iterations": value}, f"iterations {WHOLE}") for value in (0, 1.5, math.nan, "many", None)]
    + [
        ({**ADAPTS, "window": 2}, "window of a filter with adaptive_inflation 0.3 must be 0, but got 2"),
        ({"window": -1}, "window must be a whole number of at least 0, but got -1"),
    ],
    "enkf-n": [({"certainty": value}, "certainty must be .* but got") for value in (0.0, -1.0, math.nan, None)],
    "pf": [
        ({"resampling_threshold": -0.1}, "resampling_threshold must be .* but got"),
        ({"resampling_threshold": 1.1}, "resampling_threshold must be .* but got"),
        ({"resampling_threshold": "often"}, "resampling_threshold must be .* but got"),
        ({"proposal": "best"}, "proposal must be one of prior, optimal, but got 'best'"),
        ({"resampling": 1}, "resampling must be one of systematic, gaussian, but got 1"),
        ({"smoothed": [2]}, "smoothed must be a whole number from -2 to 1, but got 2"),
        ({"resampling": "gaussian", "regularisation": 0.5}, "must have no regularisation"),
    ],
    "rbpf": [({"sampled": value}, "sampled must be") for value in ((), "0", 1, (2,), (0.5,))],
    "gsf": [
        ({"parts": 6}, "parts must be a whole number of at least 7, but got 6"),
        ({"component": 2}, "component must be a whole number from -2 to 1, but got 2"),
    ],
    "fuzzy": [
        ({"low": [0.0]}, "low must be 2 finite numbers, but got"),
        ({"high": ["a"] * 2}, "high must be 2 finite numbers, but got"),
        ({"low": [2e6] * 2}, "low must be below high in every state, but got"),
        ({"blending": "mean"}, "blending must be one of weights, moments, output, but got 'mean'"),
        ({"offsets": 1}, "offsets must be True or False, but got 1"),
    ],
    "sage-husa": [
        ({"forgetting_factor": 0.0}, "forgetting_factor must be above 0 and at most 1.*but got"),
        ({"process_forgetting_factor": 1.1}, "process_forgetting_factor must be above 0.*but got"),
    ],
    "vb": [
        ({"forgetting_factor": -1}, "forgetting_factor must be above 0 and at most 1.*but got"),
        ({"prior_weight": 0.0}, "prior_weight must be positive.*but got"),
        ({"iterations": 0}, "iterations must be a whole number of at least 1.*but got"),
    ],
    "ekf-robust": [
        ({"degrees_of_freedom": 0}, "degrees_of_freedom must be positive.*but got"),
        ({"iterations": 1.5}, "iterations must be a whole number of at least 1.*but got"),
    ],
    "low-pass": [
        ({"channel": 1}, "channel must be a whole number from -1 to 0, but got 1"),
        ({"time_constant": -1.0}, "time_constant must be positive, but got -1.0"),
    ],
    "inversion": [
        ({"inverted": 2}, "inverted must be a whole number from -2 to 1, but got 2"),
        ({"inverted": -3}, "inverted must be a whole number of at least -2, but got -3"),
        ({"reach": 0.0}, "reach must be positive, but got 0.0"),
    ],
}


ROWS = [(name, *row) for name, rows in REFUSED.items() for row in rows]


@pytest.mark.parametrize(("name", "numbers", "rule"), ROWS)
def test_a_parameter_that_makes_no_filter_is_refused(name, numbers, rule):
    refused(rule, make_filter, name, thruster_model(), **numbers)


SIZES = 1, 0, -3, 2.5, math.nan, "many", None, 1_000_001
OF_SPREAD = [
    ({"inflation": 0.0}, "inflation must be positive, but got 0.0"),
    ({"inflation": math.inf}, "inflation must be a finite number, but got inf"),
    ({"relaxation": -0.1}, "relaxation must be zero or positive, but got -0.1"),
    ({"relaxation": 1.1}, "relaxation must be at most 1, but got 1.1"),
    ({"relaxation": "half"}, "relaxation must be a finite number, but got 'half'"),
    *(({"ensemble_size": size}, "ensemble_size must be .* but got") for size in SIZES),
]


@pytest.mark.parametrize(("numbers", "rule"), OF_SPREAD)
@pytest.mark.parametrize("name", [name for name, kind in FILTERS.items() if issubclass(kind, EnsembleFilter)])
def test_a_factor_or_size_that_makes_no_ensemble_is_refused(name, numbers, rule):
    refused(rule, make_filter, name, plane_model(), **numbers)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", ["pf", "apf", "rbpf"])
def test_a_number_of_particles_that_cannot_be_is_refused(name, size):
    refused("ensemble_size must be .* but got", make_filter, name, line_model(), ensemble_size=size)


def test_a_schedule_needs_points_to_lie_between():
    point = {"operating_state": [0.5], "operating_input": [0.25]}
    known = {"q": [0.1], "r": [0.1], "mean": [0.5], "cov": [0.1], **point}
    model = state_space(lambda x, u, c: (x[0] * x[0] + u[0],), lambda x, c: (x[0],), **known)
    refused("schedule must come with .*operating points, but got schedule=3", make_filter, "kf", model, schedule=3)
