"""Bursts of garbage in logs, and residuals with heavy tails: what is said, and how they are left out."""

import json
from dataclasses import replace

import numpy as np
import pytest

import tuning
from tests.linear_problem import LinearProblem
from tests.tuning.test_log_problem import GUESS, MODEL, R, logs_of
from tuning.api.report import known_table
from tuning.evaluation.held_out import evaluate_held_out, summarised, summary
from tuning.evaluation.residuals import estimated_from, heavy_tails, tails_of, uneven_nis
from tuning.evaluation.worth import uneven_sentence, warnings_of
from tuning.likelihood.identifiability import as_data, identify, sentences
from tuning.problems.log_problem import LogProblem
from tuning.reporting.choice_words import residual_sentences
from tuning.search.plan import Plan
from tuning.search.space import Choice, untuned_choice

BURST = slice(600, 700)


@pytest.fixture(scope="module")
def logs():
    return logs_of(1200, 1200, 1200)


@pytest.fixture(scope="module")
def dirty(logs):
    """The same logs with 10 s of garbage in the first one."""
    z = logs[0].measurements.copy()
    z[BURST, 0] += 15.0 * np.random.default_rng(0).standard_normal(100)
    return [replace(logs[0], measurements=z), *logs[1:]]


def with_r(factor, filter_="kf"):
    """A filter whose R is so many times the right one."""
    return Choice(filter_, {"process_noise_cov": (0.04,), "measurement_noise_cov": factor * R}, {})


def test_normal_residuals_have_no_heavy_tails_whether_or_not_they_are_correlated():
    rng, heavy = np.random.default_rng(0), 0
    for count in (50, 300, 3000):
        for _ in range(200):
            white = rng.standard_normal(count + 1)
            slow = np.empty_like(white)
            slow[0] = white[0]
            for k in range(count):
                slow[k + 1] = 0.95 * slow[k] + np.sqrt(1.0 - 0.95**2) * white[k + 1]
            heavy += tails_of(white).are_heavy + tails_of(slow).are_heavy
    assert heavy <= 6  # of 1200 samples with 0.1 % each: 1.2 expected; level 1e-3


def test_outliers_and_bursts_are_heavy_tails_however_much_they_raise_the_variance():
    rng = np.random.default_rng(1)
    for share, size in ((0.01, 10.0), (0.05, 100.0)):
        residuals = rng.standard_normal((2000, 2))
        residuals[: int(2000 * share), 1] *= size
        tails = heavy_tails(residuals, ("a", "b"))
        assert set(tails) == {"b"} and 0.3 * share < tails["b"] <= share + 1e-3
    assert tails_of(rng.standard_t(4.0, 2000)).are_heavy
    assert not tails_of(np.zeros(100)).are_heavy and not tails_of(np.full(9, np.nan)).are_heavy


def test_a_mean_nis_that_a_burst_carries_is_said_with_log_times_and_channel(logs, dirty):
    problem, clean = LogProblem(dirty, MODEL), LogProblem(logs, MODEL)
    assert uneven_nis(with_r(1.0).filter(clean), clean) is None
    uneven = uneven_nis(with_r(8.0).filter(problem), problem)
    assert uneven.mean > 0.7 and uneven.rest < 0.25 and uneven.carrying <= 4 and uneven.blocks >= 70
    said = uneven_sentence(uneven, 1)
    assert (
        f"{uneven.carrying} of {uneven.blocks} blocks carry the mean NIS" in said
        and "are of z_1, in run0 from 60" in said
    )
    assert "so that R or Q is too large for the others" in said and "--outliers missing" in said
    comparison = evaluate_held_out(with_r(8.0), problem, 0)
    assert comparison.tuned.uneven == uneven and said in warnings_of(comparison.tuned, problem)
    stored = json.loads(json.dumps(summary(comparison.tuned)))
    assert summarised(stored, problem).uneven == uneven
    assert "uneven" not in summary(comparison.untuned)


def test_outliers_of_logs_are_left_out_by_an_option_and_r_is_that_of_the_sensor(dirty):
    study = tuning.tune(tuning.read_logs(dirty, model=GUESS, outliers="missing"), "kf", trials=4, progress=False)
    assert study.choice.model["measurement_noise_cov"] == pytest.approx(R, rel=0.3)
    assert study.held_out.evaluation.uneven is None and study.held_out.evaluation.nis.covers(1.0)
    remarks = study.problem.remarks
    assert "z_1 has a burst of outliers, 9" in remarks[0] and remarks[1].startswith(
        "Outliers are left out, as missing"
    )
    problem = LogProblem(dirty, GUESS, outliers="missing")
    burst = problem.logs[0].measurements[BURST, 0]
    assert np.isnan(burst[2:-2]).all() and np.isfinite(problem.logs[1].measurements).all()
    assert problem.digest != LogProblem(dirty, GUESS).digest
    with pytest.raises(ValueError, match="outliers must be one of kept, missing, but got 'cut'"):
        LogProblem(dirty, GUESS, outliers="cut")


def test_no_factor_is_stated_within_which_innovations_with_heavy_tails_determine_a_parameter(dirty, logs):
    problem = LogProblem(dirty, GUESS)
    plan = Plan("kf", (problem,), objectives=("likelihood",))
    known = identify(with_r(8.0), plan.scenarios, plan.training_data(), plan.space())
    (said,) = sentences(known)
    assert "is not stated" in said and "of z_1 lie beyond four robust standard deviations" in said
    assert all(row["known_within_a_factor_of"] is None for row in as_data(known).values())
    assert len(known_table(known).columns) == 3
    plan = plan._replace(scenarios=(LogProblem(logs, GUESS),))
    known = identify(with_r(1.0), plan.scenarios, plan.training_data(), plan.space())
    assert "within a factor of" in sentences(known)[0] and len(known_table(known).columns) == 5


def test_noise_estimation_calls_no_residuals_with_outliers_white():
    problem = LinearProblem()
    data = problem.data(problem.training_seeds(0, 32))
    model = problem.model(**untuned_choice("kf", problem).model)
    assert not estimated_from(model, data).tails and "look like white noise" in residual_sentences(problem)[0]
    z = data.measurements.copy()
    z[:, ::50, 0] += 30.0 * np.sqrt(model.measurement_noise_cov[0, 0])
    tails = estimated_from(model, data._replace(measurements=z)).tails
    assert list(tails) == [f"v of {model.measurements[0].symbol}"] and 0.01 < next(iter(tails.values())) < 0.03
