"""The studies of papers on the thruster and on the vehicle: optima, printed tables and why ours differ."""

import json

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from filters import EnsembleKalmanFilter, ExtendedKalmanFilter, FuzzyKalmanFilter, KalmanFilter, affine_model, run
from tests.filters.checks import refused
from tests.slow import slow_but
from thruster_env.model.simulate import simulate
from thruster_env.thruster.linear import PUBLISHED
from tuning.cli import output
from tuning.experiments import thruster_papers, vehicle_runs
from tuning.experiments import vehicle_papers as estimators
from tuning.experiments.thruster_papers import NOISE_LEVELS, STEPS, STUDIES, SYSTEMS, H
from tuning.experiments.vehicle_papers import DT, NOISE, PRINTED_PATHS, TABLE_III, MeanPropagatingEnKF, PrintedRow
from tuning.experiments.vehicle_runs import PAPERS, PATHS, Task
from tuning.experiments.vehicle_tables import why_different

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
    return thruster_papers.compare_all(runs=200, members=200, seed=0)


@pytest.mark.parametrize("case", SYSTEMS)
def test_optimum_is_the_riccati_solution(case):
    a = thruster_papers.discrete_model(case, 1.0).matrices()[0]
    h = np.array(H)
    for q, expected in zip(NOISE_LEVELS, OPTIMUM[case], strict=True):
        np.testing.assert_allclose(thruster_papers.optimum(case, q), expected, atol=6e-5)
        predicted = solve_discrete_are(a.T, h.T, q * np.eye(2), q * np.eye(1))
        posterior = np.linalg.inv(np.linalg.inv(predicted) + h.T @ h / q)
        np.testing.assert_allclose(thruster_papers.optimum(case, q), np.sqrt(np.diag(posterior)), rtol=1e-9)


@pytest.mark.parametrize("table", STUDIES.values(), ids=STUDIES)
def test_published_tables_are_whole(table):
    cells = {(case, q) for case in SYSTEMS for q in NOISE_LEVELS}
    assert set(table.kf) == set(table.enkf) == cells


@pytest.mark.parametrize("case", SYSTEMS)
def test_kalman_filter_is_stationary_at_the_optimum(case):
    model, runs = thruster_papers.discrete_model(case, 0.5), 3000
    keys = np.random.default_rng(5).integers(0, 2**32, size=(runs, 2))
    inputs = np.zeros((runs, STEPS, 2))
    truth = simulate(model, keys, inputs)
    estimates = run(KalmanFilter(model=model), keys, inputs, truth.measurements)
    expected = thruster_papers.optimum(case, 0.5) ** 2
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
    model, runs, generator = (
        thruster_papers.discrete_model(case, q, prior_cov=[0, 0]),
        400,
        np.random.default_rng(11),
    )
    keys = generator.integers(0, 2**32, size=(runs, 2))
    truth = simulate(model, keys, np.zeros((runs, STEPS, 2)))
    errors = thruster_papers.unupdated_ensemble_means(model, truth.states, 100, generator) - truth.states
    single = np.sqrt(np.square(errors[:, 1:]).mean(axis=1))
    error = (2 / runs) ** 0.5 * single.std(axis=0)  # theirs and ours
    assert (np.abs(single.mean(axis=0) - UNUPDATED[case, q]) < 3 * error).all()


@pytest.mark.parametrize("name", STUDIES)
def test_published_ensemble_filters_are_explained(comparisons, name):
    ensemble = [f for f in thruster_papers.findings(STUDIES[name], comparisons) if f.filter == "enkf"]
    assert len(ensemble) == 8
    for f in ensemble:
        assert (np.abs(f.from_unupdated) < 1.5).all()
        if f.case == "tunnel":
            assert (np.abs(f.from_optimum) < 2).all() and "tie" in f.why
        else:
            assert (f.from_optimum > 20).all() and "never updated" in f.why


@pytest.mark.parametrize("name", STUDIES)
def test_published_kalman_filters_are_not_explained(comparisons, name):
    kalman = [f for f in thruster_papers.findings(STUDIES[name], comparisons) if f.filter == "kf"]
    assert len(kalman) == 8
    assert all("no mechanism known" in f.why for f in kalman)


def test_the_text_corrects_cells_of_the_table():
    cells = STUDIES["kiki2020"].kf
    assert cells["open-bladed", 0.8][:2] == (1.9957, 2.6939)  # as printed, and as both abstracts quote it
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
    said = thruster_papers.study_statements(STUDIES[name], thruster_papers.findings(STUDIES[name], comparisons))
    assert sum(rows in statement for statement in said) == 1
    assert set(STUDIES[name].remarks) <= set(said)


def test_remarks_on_papers_say_what_their_numbers_say():
    model = PUBLISHED["open_bladed"]
    (eigenvalue,) = [f"{one:.4f}" for one in np.linalg.eigvals(np.array(model.a)).real if one > 0]
    for name in ("kiki2020", "nurhadi2022"):
        assert f"{eigenvalue} of the open-bladed system is printed 31872" in " ".join(STUDIES[name].remarks)
    trace = -np.trace(np.array(model.a))
    assert f"528.83 where the trace gives {trace:.2f}" in " ".join(STUDIES["kiki2020"].remarks)
    assert f"0.065 for {model.b[0][0]}" in " ".join(STUDIES["nurhadi2022"].remarks)
    kf, enkf = STUDIES["nurhadi2022"].kf, STUDIES["nurhadi2022"].enkf
    ratios = [enkf["open-bladed", q].omega_m / kf["open-bladed", q].omega_m for q in NOISE_LEVELS]
    assert f"{min(ratios):.1f} to {max(ratios):.1f} times" in " ".join(STUDIES["nurhadi2022"].remarks)


def test_a_seed_fixes_the_result():
    first, again, other = (
        thruster_papers.compare("tunnel", 0.6, runs=20, members=30, seed=seed) for seed in (4, 4, 5)
    )
    for a, b, c in zip(first[3:], again[3:], other[3:], strict=True):
        np.testing.assert_array_equal(a.rmse, b.rmse)
        np.testing.assert_array_equal(a.low, b.low)
        assert (a.rmse != c.rmse).all()


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


GOLDEN = ((5.0**0.5 - 1.0) / 2.0 * NOISE) ** 0.5  # P = 0.618 R: Q = R, and the state itself is measured
ENDS = {  # (north, east, down) [m], of a prototype with other code
    "I": (-2.415, 3.789, 0.114),
    "II": (20.752, 0.022, 3.770),
    "III": (21.143, 0.000, 0.063),
    "IV": (10.0, 18.0, 6.0),
    "dynamic": (19.01, -4.69, 0.02),
}
GAPS = {  # x, y, z, psi: RMSE of the transformation by yaw alone on noise-free velocities, of the prototype
    "I": (0.002, 0.001, 0.061, 0.0005),
    "II": (0.164, 0.011, 2.28, 0.001),
    "III": (0.0005, 0.0004, 0.050, 0.0001),
    "IV": (0.497, 0.168, 3.73, 0.046),
    "dynamic": (0.102, 0.024, 0.360, 0.008),
}


@pytest.mark.parametrize("name", PATHS)
def test_paths_end_where_they_should_and_yaw_alone_leads_elsewhere(name):
    states = vehicle_runs.noise_free("vehicle", vehicle_runs.path_inputs(name))
    np.testing.assert_allclose(states[-1, 9:], ENDS[name], atol=6e-3)
    pose = states[:, [9, 10, 11, 8]]
    gap = np.sqrt(np.square(estimators.planar_pose(states[None, :, :6], DT)[0] - pose).mean(axis=0))
    np.testing.assert_allclose(gap, GAPS[name], rtol=0.02, atol=6e-4)
    # The full transformation of exact velocities is the exact pose, with roll and pitch told or reckoned.
    for attitude in (states[None, :, 6:8], None):
        np.testing.assert_allclose(estimators.full_pose(states[None, :, :6], attitude, DT)[0], pose, atol=2e-5)
    np.testing.assert_allclose(estimators.reckoned_attitude(states[None, :, :6], DT)[0], states[:, 6:8], atol=1e-6)


def test_inputs_of_the_dynamic_path_change_sign_as_the_sines_do():
    inputs, time = vehicle_runs.path_inputs("dynamic"), DT * np.arange(25000)
    np.testing.assert_array_equal(inputs[:, 2] > 0, (time % 14.0) < 7.0)
    np.testing.assert_array_equal(inputs[:, 3] > 0, (time % 10.0) < 5.0)
    np.testing.assert_allclose(np.unique(inputs[:, 0]), 2.84531 * np.array([0.6, 1.4]))
    np.testing.assert_allclose(inputs[:, 1], -0.006 * inputs[:, 0])
    refused("path must be one of I, II, III, IV, dynamic, but got 'V'", vehicle_runs.path_inputs, "V")


def test_measurements_alone_are_what_the_sensors_say():
    truth = vehicle_runs.true_runs(
        "vehicle", vehicle_runs.keys_of("III", 2, 0), vehicle_runs.path_inputs("III", 400)
    )
    velocities = vehicle_runs.measured_velocities(truth)
    np.testing.assert_array_equal(velocities[..., [0, 1, 2, 5]], truth.measurements)
    assert not velocities[..., 3:5].any()
    errors = (velocities - truth.states[..., :6])[..., [0, 1, 2, 5]]
    np.testing.assert_allclose(errors.std(axis=(0, 1)), 1e-3, rtol=0.1)
    scores = vehicle_runs.scores_of(
        estimators.measured(), truth, vehicle_runs.keys_of("III", 2, 0), vehicle_runs.path_inputs("III", 400)
    )
    assert np.isnan(scores.full).all() and np.isnan(scores.nees).all() and np.isfinite(scores.planar).all()


def test_bound_of_measured_velocities_is_the_golden_ratio(as_python):
    _, _, outside, bound = vehicle_runs.along_path("vehicle", vehicle_runs.path_inputs("IV", 60))
    np.testing.assert_allclose(bound.velocities[[0, 1, 2, 5]], GOLDEN, rtol=1e-3)
    assert (bound.velocities[3:5] > 2 * GOLDEN).all() and outside[-1] >= outside[:-1].max()


def test_a_forecast_from_the_mean_forgets_the_members(as_python):
    wide = estimators.papers_model("motion", integration="euler").replace(prior_cov=(1e-4,) * 8)
    u = vehicle_runs.path_inputs("I", 1)[0]
    spread = {}
    for kind in (MeanPropagatingEnKF, EnsembleKalmanFilter):
        filter_ = kind(model=wide, ensemble_size=400)
        first = filter_.init((3, 4))
        then = filter_.predict(first, u)
        spread[kind] = np.diag(then.cov)
        noise = np.sqrt(np.diag(wide.process_noise_cov))
        moved = np.array(wide.transition(tuple(first.mean), tuple(u), wide.constants))
        if kind is MeanPropagatingEnKF:
            assert (np.abs(then.mean - moved) < 4 * noise / 20).all()
    sampled = 1 + 4 * np.sqrt(2 / 400)
    np.testing.assert_array_less(spread[MeanPropagatingEnKF], sampled * np.diag(wide.process_noise_cov))
    assert (spread[EnsembleKalmanFilter] > 50 * spread[MeanPropagatingEnKF]).all()


def test_mean_propagating_filter_has_a_gain_of_one_half(as_python):
    one = {"a": [[1.0]], "b": [[0.0]], "c": [[1.0]], "process_noise_cov": [1.0], "measurement_noise_cov": [1.0]}
    model = affine_model(**one, prior_mean=[0.0], prior_cov=[1.0])
    gains = {}
    for kind in (MeanPropagatingEnKF, EnsembleKalmanFilter):
        z = 1e4 * 2.0 ** np.arange(9).reshape(1, 9, 1)  # innovations so large that perturbations do not matter
        found = run(kind(model=model, ensemble_size=1000), np.zeros((1, 2)), np.zeros((1, 8, 1)), z)
        moved = found.means[0, -1, 0] - found.means[0, -2, 0]
        gains[kind] = moved / found.innovations[0, -1, 0]
    assert gains[MeanPropagatingEnKF] == pytest.approx(0.5, abs=0.05)
    assert gains[EnsembleKalmanFilter] == pytest.approx((5**0.5 - 1) / 2, abs=0.05)
    # The error of such a filter: e' = (1 - K)(e + w) - K v.
    k = 0.5
    assert 2 / 3 == pytest.approx(((1 - k) ** 2 + k**2) / (1 - (1 - k) ** 2))


def test_own_attitude_is_what_its_own_rates_lead_to(as_python):
    own = estimators.kalman()[3].filter
    inputs, keys = np.zeros((2, 40, 6)), vehicle_runs.keys_of("dynamic", 2, 0)
    inputs[..., :4] = vehicle_runs.path_inputs("dynamic", 40)
    z = vehicle_runs.true_runs("vehicle", keys, inputs[0, :, :4]).measurements
    means = run(own, keys, inputs, z).means
    told = inputs.copy()
    told[..., 4:] = estimators.reckoned_attitude(means, DT)[:, :-1]
    assert np.abs(told[:, -1, 4:]).min() > 1e-6
    plain = run(ExtendedKalmanFilter(model=own.model), keys, told, z).means
    np.testing.assert_allclose(means, plain, atol=1e-13)
    inputs[..., 4:] = 0.3  # what is given as roll and pitch does not matter
    np.testing.assert_array_equal(run(own, keys, inputs, z).means, means)


@pytest.mark.slow
def test_filters_on_the_same_runs(as_python):
    ekf8, _, level, own = estimators.kalman()
    tasks = [Task("dynamic", "vehicle", [estimators.measured(), ekf8, level, own])]
    (result,) = vehicle_runs.run_tasks(tasks, runs=2, steps=80)
    assert [len(one.nees) for one in result.scores.values()] == [2] * 4 and result.steps == 80
    for label in ("EKF8", "EKF6 level", "EKF6 own attitude"):
        one = result.scores[label]
        np.testing.assert_allclose(one.rmse("velocities")[[0, 1, 2, 5]], GOLDEN, rtol=0.25)
        np.testing.assert_allclose(one.rmse("planar"), result.scores["EKF8"].rmse("planar"), rtol=0.1)
        assert (one.rmse("full")[:3] < 1e-3).all() and not one.divergences.any()
    assert 4 < result.scores["EKF8"].nees.mean() < 14
    again = vehicle_runs.run_tasks([Task("dynamic", "vehicle", [ekf8])], runs=2, steps=80)[0].scores["EKF8"]
    np.testing.assert_array_equal(again.velocities, result.scores["EKF8"].velocities)


def test_corners_of_the_bounds_are_unstable():
    rules = FuzzyKalmanFilter(model=estimators.level_model(), low=np.zeros(6), high=np.ones(6)).rules
    growth = [np.linalg.eigvals((rule.matrices()[0] - np.eye(6)) / DT).real.max() for rule in rules]
    assert (np.array(growth) > 1e-6).sum() == 23 and max(growth) == pytest.approx(1.77, abs=0.01)


def test_printed_tables_are_whole():
    assert set(PRINTED_PATHS) == set(PATHS) and list(TABLE_III) == [50, 100, 200, 300]
    assert [len(row.rmse) for row in TABLE_III.values()] == [4] * 4
    fourth = PRINTED_PATHS["IV"].enkf.rmse
    for name, value in TABLE_III[50].rmse.items():
        assert fourth[name] == pytest.approx(value, abs=5e-4)  # one run of the two papers is the same
    for path in PRINTED_PATHS.values():
        assert set(path.enkf.rmse) == set(path.fkf.rmse)
        assert set(path.enkf.final_percent) == set(path.fkf.final_percent)
    dynamic = PRINTED_PATHS["dynamic"]
    assert dynamic.enkf.final_percent == dynamic.enkf.rmse and dynamic.remark


def test_why_differences_are_told_by_size(as_python):
    (result,) = vehicle_runs.run_tasks(
        [Task("III", "vehicle", [estimators.measured(), estimators.kalman()[0]])], runs=2, steps=60
    )
    scores = result.scores["EKF8"]
    pose = dict(zip(("x", "y", "psi"), scores.rmse("full")[[0, 1, 3]], strict=True))
    full = why_different(PrintedRow(pose, 1.0), scores, result)
    assert full == "similar to ours by the full transformation"
    tiny = why_different(PrintedRow({"psi": 1e-3 * result.bound.pose[3]}, 1.0), scores, result)
    assert "psi below the limit" in tiny
    huge = why_different(PrintedRow({"x": 1e3, "psi": pose["psi"]}, 1.0), scores, result)
    assert "x unlike any of ours" in huge and "psi similar to" in huge
    assert "no one transformation gives the row" in huge and "transformation gives" not in full + tiny


@pytest.fixture
def quick(monkeypatch, as_python):
    """Four members in every ensemble and two rules in every fuzzy filter, as Python."""
    for name in ("EnsembleKalmanFilter", "MeanPropagatingEnKF"):
        kind = getattr(estimators, name)
        monkeypatch.setattr(estimators, name, lambda kind=kind, **given: kind(**given | {"ensemble_size": 4}))
    fuzzy = estimators.FuzzyKalmanFilter
    monkeypatch.setattr(estimators, "FuzzyKalmanFilter", lambda **given: fuzzy(premises=(0,), **given))


@pytest.mark.parametrize("paper", slow_but(PAPERS, [*PAPERS][1:]))
def test_a_paper_is_reproduced_at_the_command_line(quick, thruster, monkeypatch, tmp_path, paper):
    monkeypatch.setattr(output.console, "width", 100)
    table, picture = tmp_path / "table.json", tmp_path / "paths.png"
    options = ["--runs", "2", "--steps", "2", "--json", str(table), "--series", str(picture)]
    code, shown, _ = thruster("reproduce", paper, *options)
    assert code == 0
    assert "…" not in shown and max(map(len, shown.splitlines())) <= 100
    words = " ".join(shown.split())
    for said in ("0.082", "EnKF8", "has the conclusions", "H P H' + R", "Picture:"):
        assert said in words, said
    found = json.loads(table.read_text())
    assert found["settings"] == {"runs": 2, "seed": 0, "steps": 2} and picture.stat().st_size > 10_000
    by_path = {(one["path"], one["world"]): one["filters"] for one in found["results"]}
    if paper == "ngatini2019":
        assert [one["path"] for one in found["series"]] == ["IV"] and "0.467" in words
        sizes = [by_path["IV", "vehicle"][f"EnKF8 N={count}"] for count in (50, 100, 200, 300)]
        assert [one["published"]["seconds"] for one in sizes] == [2.819, 5.692, 11.56, 18.15]
    else:
        assert set(by_path) == {(path, "vehicle") for path in PATHS} | {("dynamic", "no restoring moments")}
        assert by_path["III", "vehicle"]["fuzzy 0..1"]["published"]["rmse"]["psi"] == 1e-5
        assert "4.83" in words
    assert all(one["why"] for filters in by_path.values() for one in filters.values() if one["published"])


def test_errors_of_yaw_are_the_short_way_round():
    true, found = np.array([[1.0, 2.0, 3.0, 6.2]]), np.array([[1.5, 2.0, 2.0, 0.1]])
    np.testing.assert_allclose(
        estimators.pose_errors(found, true), [[0.5, 0.0, -1.0, 2 * np.pi - 6.1]], atol=1e-12
    )
