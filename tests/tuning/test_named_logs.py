"""Models by name on recorded runs: any columns, numbers of the training rows alone."""

import numpy as np
import pytest

import tuning
from filters import make_filter, run
from filters.named import model_named
from tuning.api.problems import problem_of

rng = np.random.default_rng(4)
VELOCITY = np.cumsum(0.2 * rng.normal(size=300))
Z = np.cumsum(0.1 * VELOCITY) + 0.5 * rng.normal(size=300)
TRACK = {"time": 0.1 * np.arange(300), "x [m]": Z, "y [m]": Z[::-1].copy()}
NAME = "constant-velocity"


@pytest.fixture
def log(tmp_path):
    file = tmp_path / "acc.csv"
    np.savetxt(
        file, np.column_stack([TRACK["time"], Z]), delimiter=",", header="t,pos [m]", comments="", fmt="%.17g"
    )
    return file


def test_numbers_of_a_study_are_those_of_its_training_blocks(log):
    problem = problem_of((NAME, log))
    assert [parameter.name for parameter in problem.parameters] == ["acceleration", "R"]
    blocks, lead = problem.parts.blocks, problem.parts.lead
    known = np.full(300, np.nan)
    for block in blocks[: len(problem.parts.training)]:
        rows = slice(block.first + lead, block.first + block.rows)
        known[rows] = Z[rows]
    fit = tuning.fit(known, 0.1, model=NAME)
    assert problem.given == pytest.approx({"acceleration": fit.numbers[0].value, "R": fit.r}, rel=1e-3)
    changed = known.copy()
    changed[np.isnan(known)] = rng.normal(size=np.isnan(known).sum())
    again = problem_of((NAME, {"time": TRACK["time"], "pos [m]": changed}))
    assert again.given == pytest.approx(problem.given, rel=1e-9)  # held-out rows and lead-ins count for nothing


def test_an_estimate_uses_given_numbers_or_finds_them_and_says_which(log):
    model = model_named(f"{NAME}:acceleration=0.5,R=0.3")(dt=0.1)
    stated = tuning.estimate((f"{NAME}:acceleration=0.5,R=0.3", log), filter="kf")
    np.testing.assert_allclose(stated.filter.model.process_noise_cov, model.process_noise_cov, rtol=1e-9)
    assert not any("maximum-likelihood" in sentence for sentence in stated.sentences())
    free, fit = tuning.estimate((NAME, log), filter="kf"), tuning.fit(log, model=NAME)
    assert free.filter.model.measurement_noise_cov[0, 0] == pytest.approx(fit.r, rel=1e-4)
    assert any(f'--model "{NAME}:acceleration=' in sentence for sentence in free.sentences())
    for numbers in (Z, Z.tolist()):
        reading = tuning.read_logs(numbers, model=f"{NAME}:acceleration=0.5,R=0.3", dt=0.1)
        np.testing.assert_allclose(tuning.estimate(reading, filter="kf").means, stated.means, rtol=1e-6, atol=1e-6)


def test_identified_numbers_are_those_of_fit_and_a_preset_for_other_commands(log, tmp_path):
    identified = tuning.identify((NAME, log), starts=1, use_all=True, progress=False)
    fit = tuning.fit(log, model=NAME)
    assert set(identified.values) == {"acceleration", "R"} and identified.values["R"] == pytest.approx(
        fit.r, rel=0.05
    )
    file = identified.save(tmp_path / "found.toml")
    runs = tuning.read_logs(log, model=NAME, preset=file)
    used = tuning.estimate(runs, filter="kf").filter.model
    assert used.measurement_noise_cov[0, 0] == pytest.approx(identified.values["R"], rel=1e-12)


def test_a_tuned_file_of_a_named_model_needs_no_model_again(log, tmp_path):
    study = tuning.tune(("auto", str(log)), filter="kf", trials=3, progress=False)
    assert study.problem.as_mapping()["options"]["model"] == NAME
    file = study.save(tmp_path / "tuned.json")
    used = tuning.estimate(str(log), file).filter.model
    np.testing.assert_allclose(used.process_noise_cov, study.filter.model.process_noise_cov, rtol=1e-12)
    assert not any("maximum-likelihood" in sentence for sentence in tuning.estimate(log, file).sentences())


def test_a_clock_offset_beside_a_file_changes_no_fit(tmp_path):
    rng, file = np.random.default_rng(0), tmp_path / "run.csv"
    z = np.cumsum(0.3 * rng.normal(size=(200, 2)), axis=0) + rng.normal(size=(200, 2))
    table = np.column_stack([0.1 * np.arange(200), z])
    np.savetxt(file, table, delimiter=",", header="t,x,y", comments="")
    options = {"model": "constant", "column": "x,y"}
    before = tuning.fit(file, **options)
    file.with_suffix(".toml").write_text("[clock_offset]\nx = 0.05\ny = 0.05\n")
    np.testing.assert_array_equal(tuning.fit(file, **options).r, before.r)
    file.with_suffix(".toml").write_text("[clock_offset]\nx = 0.05\n")
    with pytest.raises(ValueError, match="columns of a fit must have one clock, but .* has x = 0.05"):
        tuning.fit(file, **options)


def test_a_clock_offset_of_all_columns_moves_no_number():
    options = {"model": f"{NAME}:acceleration=1", "columns": ["x,y"]}
    log, maker = tuning.read_logs(TRACK, **options).read()
    moved, of_moved = tuning.read_logs(TRACK, **options, clock_offset={"x": 0.05, "y": 0.05}).read()
    np.testing.assert_array_equal(moved.measurements, log.measurements)
    assert of_moved.values == maker.values and moved.start == pytest.approx(log.start - 0.05)
    reading = tuning.read_logs(TRACK, **options, clock_offset={"x": 0.05})
    with pytest.raises(ValueError, match="must come with all its numbers where columns have own clock"):
        tuning.estimate(reading, filter="kf")
    with pytest.raises(ValueError, match="clock offsets must be of channels x, y, but got 'z'"):
        tuning.read_logs(TRACK, **options, clock_offset={"z": 0.05}).read()


def test_columns_of_axes_are_those_that_are_named_or_as_many():
    runs = [
        tuning.read_logs(TRACK, model=f"{NAME}:axes=2,acceleration=1,R=1"),
        tuning.read_logs(TRACK, model=f"{NAME}:acceleration=1,R=1", columns=["x,y"]),
    ]
    for each in runs:
        recorded, maker = each.read()
        assert [quantity.symbol for quantity in recorded.measured] == ["x", "y"] and maker(dt=0.1).n == 4
    with pytest.raises(ValueError, match=r"one column of numbers beside its times"):
        tuning.read_logs(TRACK, model=NAME).read()
    with pytest.raises(ValueError, match="of 3 axes must have as many columns"):
        tuning.read_logs(TRACK, model=f"{NAME}:axes=3", columns=["x,y"]).read()


def test_numbers_without_a_model_and_logs_of_another_plant_name_the_way():
    with pytest.raises(ValueError, match=r"tuning.fit\(z, dt=0.1\) finds the model"):
        tuning.tune(Z)
    with pytest.raises(ValueError, match=r"dt must be given to tuning.read_logs.*tuning.fit\(z, dt=0.1\)"):
        tuning.tune(Z, dt=0.1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'trial'"):
        tuning.tune("mismatch", trial=3)
    with pytest.raises(ValueError, match="has time, x .m., y .m.: tuning.fit finds a model.*--model auto"):
        tuning.estimate(TRACK)


def test_an_estimate_on_its_own_stamps_has_the_q_of_each_step():
    times = np.cumsum(rng.uniform(0.05, 0.15, 300))
    reading = {"model": f"{NAME}:acceleration=0.5,R=0.3", "grid": False, "dt": 0.1}
    estimate = tuning.estimate(tuning.read_logs({"t": times, "pos": Z}, **reading), filter="ekf")
    maker = model_named(reading["model"])
    plant = maker.continuous(dt=0.1)
    filter_ = make_filter("ekf", estimate.filter.model.replace(process_noise_cov=plant.noise(0.1)))
    by_run = run(filter_, Z, dt=np.diff(times), noise=plant.noise)
    np.testing.assert_allclose(estimate.means, by_run.means, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="must be tuned or identified on a grid, but run1 is on its own stamps"):
        problem_of(tuning.read_logs({"t": times, "pos": Z}, **reading))
