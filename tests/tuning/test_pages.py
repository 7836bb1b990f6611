"""Tables of docs/appendix on filters of the vehicle and a wrong model: what pages claim, in a quick form."""

import re
from pathlib import Path

import numpy as np
import pytest

from docs.scripts import main
from docs.scripts.auv import EKF, FILTERS, MOTION, NAVIGATION, TABLES, about, restless, rows_of, small
from docs.scripts.tuning import LIFT, RIGHT, SLOPES, UNKNOWNS, bought, lifted, plans
from filters.consistency.nees import Interval
from tuning.plants import auv
from tuning.plants.thruster import find_scenario

PAGE = (Path(__file__).parents[2] / "docs" / "appendix" / "auv.md").read_text()
BAND = (0.8, 1.25)  # of the mean NIS over what is right, as a study holds it


def printed(name):
    """Cells of a table of the page, a row each."""
    text = re.search(rf"<!-- table {name} -->\n(.*?)\n<!-- end -->", PAGE, flags=re.DOTALL)[1]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]


def numbers(cell):
    """All numbers of a cell."""
    return [float(part) for part in re.findall(r"[\d.]+(?:e[+-]?\d+)?", cell)]


def by_label(name):
    """NEES with half of its interval, mean NIS over what is right, and score over the EKF's, by filter."""
    found = {}
    for label, ratio, nees, nis in printed(name):
        found[label] = numbers(nees), float(nis), numbers(ratio)[0]
    return found


def test_pages_have_every_table_with_half_intervals_and_full_q_where_they_say_so():
    assert set(TABLES) < set(re.findall(r"<!-- table (\w+) -->", PAGE))
    scenarios = [row[0].strip("`") for row in printed("filters_motion")]
    assert scenarios == [name for name in MOTION for _ in FILTERS]
    assert {row[0].strip("`") for row in printed("filters_navigation")} <= set(NAVIGATION)
    assert about(Interval(21.374, 20.47, 22.27)) == "21.37 ± 0.90"
    assert about(Interval(161160.6, 112706.8, 217080.6)) == "161000 ± 52000"
    assert [plan.full_q for plan in plans().values()] == [False, True, False, False, False, False]
    assert all("`ekf` + " not in name for name in plans()) and len(UNKNOWNS) == 5


def test_members_cost_consistency_until_300_relaxation_cures_50_and_nothing_at_1_khz():
    found = by_label("filters_members")
    for label, nees in {"ekf": 8.0, "ukf": 8.0}.items():
        assert found[label][0][0] == pytest.approx(nees, abs=0.15)
    for size, nees in {50: 21.0, 100: 13.0, 200: 10.2, 300: 9.5}.items():
        assert found[f"enkf {size}"][0][0] == pytest.approx(nees, rel=0.08)
    found = by_label("filters_cures")
    for label in ("etkf 50 relaxation 0.45", "etkf 50 inflation 1.02 relaxation 0.3"):
        (nees, half), nis, ratio = found[label]
        assert nees + half < 10 and BAND[0] < nis < BAND[1] and ratio < 1.15
    found = by_label("filters_fast")
    for label, (nees, _), _, ratio in ((label, *rest) for label, rest in found.items()):
        if " 50" in label:
            assert nees > 100 or ratio > 100
    assert found["ekf"][0][0] == pytest.approx(8.0, abs=0.7)


@pytest.mark.slow
def test_fifty_members_claim_too_much_and_relaxation_with_inflation_cures_it():
    """With 6 runs of 25 s the NEES of 50 members, of some 21, is known to within 1.5 at 95 %."""
    scenario = auv.find_scenario("auv:papers_20hz").replace(steps=500)
    cured = small("enkf", inflation=1.05, relaxation=0.3)
    ekf, few, cure = (row.evaluation for row in rows_of(scenario, [EKF, small("enkf"), cured], 6))
    assert ekf.nees.high < 9 and few.nees.low > 16 and cure.nees.high < 10
    assert BAND[0] < cure.nis.value / cure.expected_nis < BAND[1]
    assert abs(ekf.nis.value - 4.0) < 0.1


def test_restless_angles_are_the_model_s_and_no_other_number_changes():
    scenario = auv.find_scenario("auv:papers_20hz")
    known, changed = small("enkf").filter(scenario), restless(small("enkf"), 1e-6).filter(scenario)
    before, after = known.model.process_noise_cov.diagonal(), changed.model.process_noise_cov.diagonal()
    assert after[6:].tolist() == [1e-6, 1e-6] and after[:6].tolist() == before[:6].tolist()
    assert changed.size == known.size == 50


def test_only_the_table_that_is_asked_for_is_made(tmp_path, monkeypatch):
    made = {name: (lambda: "new") for name in TABLES}
    monkeypatch.setattr("docs.scripts.auv.TABLES", made)
    page = tmp_path / "auv.md"
    page.write_text("<!-- table filters_fast -->\n<!-- end -->\n<!-- table filters_drag -->\n<!-- end -->\n")
    main(["auv", "--out", str(tmp_path), "--table", "filters_drag"])
    begins = "<!-- table filters_fast -->\n<!-- end -->\n"
    assert page.read_text() == f"{begins}<!-- table filters_drag -->\nnew\n<!-- end -->\n"


MISMATCH = find_scenario("mismatch")


def test_the_factor_on_the_lift_is_that_of_the_parameters():
    model = lifted(MISMATCH, measurement_noise_cov=0.3)
    plain = MISMATCH.model(parameter_factors={"lift_coefficient": 1.15 * 0.8, "voltage_gain": 0.95})
    constants = model.constants._replace(**{LIFT: 0.8})
    state, voltage = np.array([150.0, 1.2]), np.array([7.0])
    for name, arguments in (("observe", (state,)), ("transition", (state, voltage))):
        ours = getattr(model, name)(*arguments, constants)
        known = getattr(plain, name)(*arguments, plain.constants)
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
