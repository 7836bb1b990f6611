import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from filters import KalmanFilter, run
from thruster_env.model.simulate import simulate
from thruster_env.thruster.linear import PUBLISHED
from tuning.experiments.thruster_papers import (
    NOISE_LEVELS,
    STEPS,
    STUDIES,
    SYSTEMS,
    H,
    compare,
    compare_all,
    discrete_model,
    findings,
    optimum,
    study_statements,
    unupdated_ensemble_means,
)

# The Riccati values and the errors of the un-updated ensemble, computed independently of this package.
OPTIMUM = {
    "tunnel": [(0.8066, 0.1457), (0.8836, 0.1596), (1.0203, 0.1843), (1.1407, 0.2060)],
    "open-bladed": [(0.8366, 0.1504), (0.9165, 0.1647), (1.0583, 0.1902), (1.1832, 0.2127)],
}
UNUPDATED = {  # (case, q): mean over 400 runs of the RMSE of a single run from x_0 = 0
    ("tunnel", 0.5): (0.801, 0.133),
    ("open-bladed", 0.5): (3.89, 0.647),
    ("open-bladed", 0.6): (4.26, 0.709),
    ("open-bladed", 0.8): (4.92, 0.818),
    ("open-bladed", 1.0): (5.50, 0.915),
}


@pytest.fixture(scope="module")
def comparisons():
    return compare_all(runs=200, members=200, seed=0)


@pytest.mark.parametrize("case", SYSTEMS)
def test_optimum_is_the_riccati_solution(case):
    a = discrete_model(case, 1.0).matrices()[0]
    h = np.array(H)
    for q, expected in zip(NOISE_LEVELS, OPTIMUM[case], strict=True):
        np.testing.assert_allclose(optimum(case, q), expected, atol=6e-5)
        predicted = solve_discrete_are(a.T, h.T, q * np.eye(2), q * np.eye(1))
        posterior = np.linalg.inv(np.linalg.inv(predicted) + h.T @ h / q)
        np.testing.assert_allclose(optimum(case, q), np.sqrt(np.diag(posterior)), rtol=1e-9)


@pytest.mark.parametrize("table", STUDIES.values(), ids=STUDIES)
def test_published_tables_are_whole(table):
    cells = {(case, q) for case in SYSTEMS for q in NOISE_LEVELS}
    assert set(table.kf) == set(table.enkf) == cells


@pytest.mark.parametrize("case", SYSTEMS)
def test_kalman_filter_is_stationary_at_the_optimum(case):
    model, runs = discrete_model(case, 0.5), 3000
    keys = np.random.default_rng(5).integers(0, 2**32, size=(runs, 2))
    inputs = np.zeros((runs, STEPS, 2))
    truth = simulate(model, keys, inputs)
    estimates = run(KalmanFilter(model=model), keys, inputs, truth.measurements)
    expected = optimum(case, 0.5) ** 2
    np.testing.assert_allclose(np.diagonal(estimates.covs[0], axis1=1, axis2=2), np.tile(expected, (101, 1)))
    squares = np.square(estimates.means - truth.states).mean(axis=1)
    error = squares.std(axis=0) / runs**0.5
    assert (np.abs(squares.mean(axis=0) - expected) < 4 * error).all()
    assert (error / expected < 0.005).all()


@pytest.mark.slow
def test_intervals_of_the_kalman_filter_cover_the_optimum(comparisons):
    covered = np.array([(c.kf.low <= c.optimum) & (c.optimum <= c.kf.high) for c in comparisons])
    assert covered.sum() >= 14  # of 16, two states in each row; one in twenty may miss
    for c in comparisons:
        assert (np.abs(c.kf.rmse - c.optimum) < 3.5 * c.kf.run_std / 200**0.5).all()
        assert (c.kf.low < c.kf.rmse).all() and (c.kf.rmse < c.kf.high).all()


@pytest.mark.slow
def test_ensemble_filter_ties_with_the_kalman_filter(comparisons):
    for c in comparisons:
        assert (np.abs(c.enkf_over_kf - 1) < 0.03).all()
        assert (np.abs(c.enkf_identity.rmse / c.kf_identity.rmse - 1) < 0.03).all()
        assert (np.abs(c.kf_identity.rmse / c.kf.rmse - 1) < 0.01).all()


@pytest.mark.parametrize(("case", "q"), UNUPDATED)
def test_unupdated_ensemble_from_a_known_start(case, q):
    model, runs, generator = discrete_model(case, q, prior_cov=[0, 0]), 400, np.random.default_rng(11)
    keys = generator.integers(0, 2**32, size=(runs, 2))
    truth = simulate(model, keys, np.zeros((runs, STEPS, 2)))
    errors = unupdated_ensemble_means(model, truth.states, 100, generator) - truth.states
    single = np.sqrt(np.square(errors[:, 1:]).mean(axis=1))
    error = (2 / runs) ** 0.5 * single.std(axis=0)  # theirs and ours
    assert (np.abs(single.mean(axis=0) - UNUPDATED[case, q]) < 3 * error).all()


@pytest.mark.parametrize("name", STUDIES)
def test_published_ensemble_filters_are_explained(comparisons, name):
    ensemble = [f for f in findings(STUDIES[name], comparisons) if f.filter == "enkf"]
    assert len(ensemble) == 8
    for f in ensemble:
        assert (np.abs(f.from_unupdated) < 1.5).all()
        if f.case == "tunnel":
            assert (np.abs(f.from_optimum) < 2).all() and "tie" in f.why
        else:
            assert (f.from_optimum > 20).all() and "never updated" in f.why


@pytest.mark.parametrize("name", STUDIES)
def test_published_kalman_filters_are_not_explained(comparisons, name):
    kalman = [f for f in findings(STUDIES[name], comparisons) if f.filter == "kf"]
    assert len(kalman) == 8
    assert all("no mechanism known" in f.why for f in kalman)


def test_the_text_corrects_cells_of_the_table():
    cells = STUDIES["kiki2020"].kf
    assert cells["open-bladed", 0.8][:2] == (
        1.9957,
        2.6939,
    )  # as the table is printed, and both abstracts quote it
    assert cells["open-bladed", 0.8].meant == (2.6821, 2.6939)
    assert cells["open-bladed", 0.5].meant == (2.7061, 1.9870) and cells["tunnel", 0.5].meant == (0.8740, 0.9232)
    assert cells["tunnel", 0.6].meant == cells["tunnel", 0.6][:2]
    every = [value for table in STUDIES.values() for cell in table.kf.values() for value in cell[:2]]
    assert every.count(1.9957) == 1


@pytest.mark.parametrize(
    ("name", "rows"),
    [("kiki2020", "in 7 of 8 rows (6 by the table, which the text corrects)"), ("nurhadi2022", "in 7 of 8 rows,")],
)
def test_rows_with_equal_errors_in_both_states(comparisons, name, rows):
    said = study_statements(STUDIES[name], findings(STUDIES[name], comparisons))
    assert sum(rows in statement for statement in said) == 1
    assert set(STUDIES[name].remarks) <= set(said)


def test_misprints_of_the_linear_models_are_in_the_remarks_of_the_papers():
    model = PUBLISHED["open_bladed"]
    (eigenvalue,) = [f"{one:.4f}" for one in np.linalg.eigvals(np.array(model.a)).real if one > 0]
    for name in ("kiki2020", "nurhadi2022"):
        assert f"{eigenvalue} of the open-bladed system is printed 31872" in " ".join(STUDIES[name].remarks)
    trace = -np.trace(np.array(model.a))
    assert f"528.83 where the trace gives {trace:.2f}" in " ".join(STUDIES["kiki2020"].remarks)
    assert f"0.065 for {model.b[0][0]}" in " ".join(STUDIES["nurhadi2022"].remarks)


def test_by_the_article_s_own_numbers_the_ensemble_filter_is_the_worse_one_in_the_motor_speed():
    kf, enkf = STUDIES["nurhadi2022"].kf, STUDIES["nurhadi2022"].enkf
    ratios = [enkf["open-bladed", q].omega_m / kf["open-bladed", q].omega_m for q in NOISE_LEVELS]
    assert f"{min(ratios):.1f} to {max(ratios):.1f} times" in " ".join(STUDIES["nurhadi2022"].remarks)


def test_a_seed_fixes_the_result():
    first, again, other = (compare("tunnel", 0.6, runs=20, members=30, seed=seed) for seed in (4, 4, 5))
    for a, b, c in zip(first[3:], again[3:], other[3:], strict=True):
        np.testing.assert_array_equal(a.rmse, b.rmse)
        np.testing.assert_array_equal(a.low, b.low)
        assert (a.rmse != c.rmse).all()


@pytest.mark.parametrize(
    ("arguments", "rule"),
    [
        ({"case": "ducted"}, "case must be one of"),
        ({"q": 0.0}, "q must be positive"),
        ({"runs": 1}, "runs must be a whole number of at least 2"),
        ({"members": 1}, "members must be a whole number of at least 2"),
        ({"seed": -1}, "seed must be a whole number of at least 0"),
    ],
)
def test_wrong_arguments(arguments, rule):
    with pytest.raises(ValueError, match=rule):
        compare(**{"case": "tunnel", "q": 0.5, **arguments})


def test_json_on_standard_output_is_whole(as_json):
    data = as_json("reproduce", "thruster-papers", "--runs", 4, "--members", 5, "--seed", 3)
    assert data["settings"] == {"runs": 4, "members": 5, "seed": 3}
    assert [(r["case"], r["q"]) for r in data["results"]] == [(c, q) for c in SYSTEMS for q in NOISE_LEVELS]
    for result in data["results"]:
        for name in ("kf", "enkf", "kf_identity", "enkf_identity", "unupdated"):
            assert set(result[name]) == {"rmse", "low", "high", "run_std", "run_ratio"}
            assert np.isfinite(np.array(list(result[name].values()))).all()
    assert set(data["studies"]) == set(STUDIES)
    for study in data["studies"].values():
        assert len(study["rows"]) == 16 and study["source"] and study["statements"]
        assert all(row["why"] and len(row["published"]) == 2 for row in study["rows"])
