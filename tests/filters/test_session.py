"""A belief belongs to a kind of filter and a model; another one's is refused in one line."""

import numpy as np
import pytest

from filters import affine_model, make_filter, thruster_model
from filters.engine.session import Session
from numerics.compiled import interpreted


def of_three_states():
    return affine_model(
        a=0.9 * np.eye(3),
        b=np.ones((3, 1)),
        c=[[1.0, 0.0, 0.0]],
        process_noise_cov=[0.1] * 3,
        measurement_noise_cov=[0.2],
        prior_mean=[0.0] * 3,
        prior_cov=[1.0] * 3,
    )


def made(name, model=thruster_model, **numbers):
    return make_filter(name, model(), **numbers)


@pytest.mark.parametrize(
    ("filter_", "other", "rule"),
    [
        (made("ekf"), made("enkf", ensemble_size=9), r"members of .* 'ekf' .* shape \(2, 0\), but got \(2, 9\)"),
        (made("enkf"), made("ekf"), r"members of .* 'enkf' .* shape \(2, 100\), but got \(2, 0\)"),
        (made("enkf", ensemble_size=9), made("etkf", ensemble_size=1 + 9), r"\(2, 9\), but got \(2, 10\)"),
        (made("enkf", ensemble_size=9), made("pf", ensemble_size=9), r"\(2, 9\), but got \(3, 9\)"),
        (made("pf", ensemble_size=9), made("enkf", ensemble_size=9), r"\(3, 9\), but got \(2, 9\)"),
        (made("vb"), made("ekf"), r"extras of .* 'vb' .* shape \(2,\), but got \(0,\)"),
        (made("ekf"), made("vb"), r"extras of .* 'ekf' .* shape \(0,\), but got \(2,\)"),
        (made("ekf"), made("ekf", of_three_states), r"mean of .* 'ekf' .* shape \(2,\), but got \(3,\)"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_belief_of_another_filter_is_refused(filter_, other, rule):
    with interpreted():
        belief = other.init((1, 2))
        for use in (lambda: filter_.predict(belief, [1.0]), lambda: filter_.update(belief, [1.0])):
            with pytest.raises(ValueError, match=rule) as error:
                use()
            assert "\n" not in str(error.value)


def test_a_session_goes_on_from_a_belief_of_its_own_filter():
    with interpreted():
        filter_ = made("pf", ensemble_size=9)
        belief, _ = filter_.update(filter_.init((1, 2)), [3.0])
        session = Session(filter_)
        session.load(belief)
        session.step([5.0], [4.0])
        expected, _ = filter_.update(filter_.predict(belief, [5.0]), [4.0])
        np.testing.assert_array_equal(session.belief().members, expected.members)
