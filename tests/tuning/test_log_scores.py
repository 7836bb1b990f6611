"""The log score of the state by which trials are told apart: of states that count, and of a P that is regular."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import make_filter, run
from tests.linear_problem import LinearProblem
from thruster_env.core.compiled import interpreted
from tuning.evaluation.runs import log_scores_of
from tuning.search.plan import LARGEST

PROBLEM = LinearProblem()
DATA = PROBLEM.data(range(3))
FILTER = make_filter("kf", PROBLEM.model())
with interpreted():  # each worker of pytest imports this file
    ESTIMATES = run(FILTER, DATA.filter_keys, DATA.inputs, DATA.measurements)


def scores(scale, covs=ESTIMATES.covs, data=DATA):
    steps = log_scores_of(FILTER, ESTIMATES._replace(covs=covs), data, scale)
    assert steps.shape == (3, 61)
    return np.nanmean(steps, axis=1)


def by_hand(places, counted=None):
    found = []
    for b in range(3):
        steps = [k for k in range(DATA.first_scored, 71) if counted is None or counted[b, k]]
        found.append(
            np.mean(
                [
                    multivariate_normal(
                        ESTIMATES.means[b, k, places], ESTIMATES.covs[b, k][np.ix_(places, places)]
                    ).logpdf(DATA.states[b, k, places])
                    for k in steps
                ]
            )
        )
    return found


@pytest.mark.parametrize(
    ("scale", "places"),
    [((0.3, 0.3, 0.3), [0, 1, 2]), ((0.3, math.inf, 0.1), [0, 2]), ((math.inf, 1.0, math.inf), [1])],
)
def test_the_log_score_is_the_density_of_the_states_that_count(scale, places):
    np.testing.assert_allclose(scores(scale), by_hand(places), rtol=1e-9)


def test_a_state_that_does_not_count_and_is_known_to_the_last_digit_earns_nothing():
    sure = ESTIMATES.covs.copy()
    sure[..., 1, :] = sure[..., :, 1] = 0.0
    sure[..., 1, 1] = 1e-300
    scale = (0.3, math.inf, 0.3)
    np.testing.assert_allclose(scores(scale, sure), by_hand([0, 2]), rtol=1e-9)


def test_a_singular_covariance_has_the_least_score_and_is_not_left_out():
    singular = ESTIMATES.covs.copy()
    singular[1, 40:, 1, :] = singular[1, 40:, :, 1] = 0.0
    singular[2] = np.nan
    first, some, none = scores(PROBLEM.scale, singular)
    assert first == pytest.approx(by_hand([0, 1, 2])[0]) and none == -LARGEST
    assert some == pytest.approx(-LARGEST * 31 / 61, rel=1e-3)


def test_only_scored_steps_count_and_without_truth_there_is_no_score():
    counted = np.ones((3, 71), dtype=bool)
    counted[0, 30:] = counted[2, ::2] = False
    found = scores(PROBLEM.scale, data=DATA._replace(counted=counted))
    np.testing.assert_allclose(found, by_hand([0, 1, 2], counted), rtol=1e-9)
    assert np.isnan(log_scores_of(FILTER, ESTIMATES, DATA._replace(states=None), None)).all()
