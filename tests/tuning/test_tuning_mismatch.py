"""What tuning can buy where the model is wrong: a table of docs/appendix/tuning.md, in a small form."""

import numpy as np
import pytest

from docs.scripts.tuning import LIFT, RIGHT, SLOPES, UNKNOWNS, bought, lifted, plans
from tuning.plants.thruster import find_scenario

MISMATCH = find_scenario("mismatch")


def test_the_factor_on_the_lift_is_that_of_the_parameters():
    model = lifted(MISMATCH, measurement_noise_cov=0.3)
    plain = MISMATCH.model(parameter_factors={"lift_coefficient": 1.15 * 0.8, "voltage_gain": 0.95})
    constants = model.constants._replace(**{LIFT: 0.8})
    state, voltage = np.array([150.0, 1.2]), np.array([7.0])
    for name, arguments in (("observe", (state,)), ("transition", (state, voltage))):
        ours, known = (
            getattr(model, name)(*arguments, constants),
            getattr(plain, name)(*arguments, plain.constants),
        )
        np.testing.assert_allclose(ours, known, rtol=1e-12)
    assert len(SLOPES) == 8 and model.measurement_noise_cov[0, 0] == 0.3


@pytest.mark.slow
def test_lift_and_voltage_gain_as_states_buy_what_no_q_can():
    names = "`ekf`, Q and R", "`ekf` + lift and K2", RIGHT
    lines = bought(trials=1, rows=names, seeds=20).splitlines()[2:]
    rows = [line.strip("| ").split(" | ") for line in lines]
    ratios = [float(row[1].split()[0]) for row in rows]
    assert [row[0] for row in rows] == ["`ekf`, scaled default", *names]
    assert ratios[0] == 1.0 and 0.25 < ratios[3] < ratios[2] < 0.6 < ratios[1] < 1.0  # by the baselines alone
    assert float(rows[2][4]) < 3.0 < 10.0 < float(rows[0][4])  # the NEES says that no covariance holds a bias


def test_a_full_q_is_searched_where_the_table_says_so():
    assert [plan.full_q for plan in plans().values()] == [False, True, False, False, False, False]
    assert all("`ekf` + " not in name for name in plans()) and len(UNKNOWNS) == 5
