"""Which filter, which N for the vehicle: claims of docs/auv.md in a quick form, and by its tables."""

import pytest

from docs.scripts import main
from docs.scripts.auv import EKF, TABLES, restless, rows_of, small
from tuning.auv.scenario import find_scenario

BAND = (0.8, 1.25)  # of the mean NIS over what is right, as a study holds it


@pytest.mark.slow
def test_fifty_members_claim_too_much_and_relaxation_with_inflation_cures_it():
    """With 6 runs of 25 s the NEES of 50 members, of some 21, is known to within 1.5 at 95 %."""
    scenario = find_scenario("auv:papers_20hz").replace(steps=500)
    cured = small("enkf", inflation=1.05, relaxation=0.3)
    ekf, few, cure = (row.evaluation for row in rows_of(scenario, [EKF, small("enkf"), cured], 6))
    assert ekf.nees.high < 9 and few.nees.low > 16 and cure.nees.high < 10
    assert BAND[0] < cure.nis.value / cure.expected_nis < BAND[1]
    assert abs(ekf.nis.value - 4.0) < 0.1


def test_restless_angles_are_the_model_s_and_no_other_number_changes():
    scenario = find_scenario("auv:papers_20hz")
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
    assert page.read_text() == (
        "<!-- table filters_fast -->\n<!-- end -->\n<!-- table filters_drag -->\nnew\n<!-- end -->\n"
    )
