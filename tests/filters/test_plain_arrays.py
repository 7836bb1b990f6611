"""A single trajectory without the axis of a batch, lists, pandas, inputs of each row, no keys."""

import numpy as np
import pytest

import filters
import tuning
from filters import EnsembleKalmanFilter, KalmanFilter, run, smooth
from filters.named import model_named
from tests.filters.checks import refused
from tests.models import wide_model
from tests.oracles import each_equal
from thruster_env.core.streams import filter_keys
from thruster_env.model.affine import affine_model


@pytest.fixture(scope="module")
def walk():
    return filters.make_filter("kf", model_named("constant-velocity:acceleration=0.04,R=0.25")(dt=0.1))


def driven(m=1):
    return filters.make_filter(
        "ekf",
        filters.affine_model(
            a=[[1.0, 0.1], [0.0, 0.9]],
            b=[[0.0], [0.5]],
            c=np.eye(2)[:m],
            process_noise_cov=[0.01, 0.02],
            measurement_noise_cov=[0.3] * m,
            prior_mean=[0.0, 0.0],
            prior_cov=[1.0, 1.0],
        ),
    )


Z = np.sin(0.3 * np.arange(40.0)) + np.where(np.arange(40) % 7 == 3, np.nan, 0.0)


def equals_batch(single, batch):
    assert type(single) is type(batch)
    for array, part in zip(single, batch, strict=True):
        np.testing.assert_array_equal(array, part[0])


@pytest.mark.parametrize("form", [list, np.array, lambda z: z[:, None]])
def test_a_column_is_a_batch_of_one(walk, form):
    batch = filters.run(walk, inputs=np.zeros((1, 39, 0)), measurements=Z[None, :, None])
    single = filters.run(walk, form(Z))
    equals_batch(single, batch)
    assert single.means.shape == (40, 2) and single.innovations.shape == (40, 1)
    assert single.stds[3, 1] == pytest.approx(np.sqrt(single.covs[3, 1, 1])) and single.stds.shape == (40, 2)
    equals_batch(
        filters.smooth(walk, form(Z)),
        filters.smooth(walk, inputs=np.zeros((1, 39, 0)), measurements=Z[None, :, None]),
    )


def test_pandas_columns_and_tables(walk):
    pandas = pytest.importorskip("pandas")
    equals_batch(filters.run(walk, pandas.Series(Z)), filters.run(walk, Z[None, :, None]))
    table = pandas.DataFrame({"a": Z, "b": 0.5 * Z})
    u = 0.1 * np.arange(39.0)
    batch = filters.run(driven(2), inputs=u[None, :, None], measurements=table.to_numpy()[None])
    equals_batch(filters.run(driven(2), inputs=pandas.Series(u), measurements=table), batch)


def test_an_input_of_the_last_row_moves_nothing():
    u = np.cos(np.arange(40.0))
    batch = filters.run(driven(), inputs=u[None, :-1, None], measurements=Z[None, :, None])
    for inputs in (u, u[:-1], u[:, None], u.tolist()):
        equals_batch(filters.run(driven(), inputs=inputs, measurements=Z), batch)
    assert not np.array_equal(filters.run(driven(), inputs=u[::-1], measurements=Z).means, batch.means[0])


def test_many_runs_of_measurements_alone(walk):
    z = np.stack([Z, 2.0 * Z])[..., None]
    together = filters.run(walk, z)
    assert together.means.shape == (2, 40, 2)
    np.testing.assert_array_equal(together.means[0], filters.run(walk, Z).means)


def test_an_ensemble_draws_as_the_batch_of_one_does():
    enkf = filters.make_filter("enkf", driven().model, ensemble_size=20)
    u = np.zeros(39)
    equals_batch(
        filters.run(enkf, inputs=u, measurements=Z), filters.run(enkf, None, u[None, :, None], Z[None, :, None])
    )


U = np.zeros(39)
DRIVEN = {"inputs": U, "measurements": Z}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"keys": Z}, "a model with 1 input must get it"),
        ({"inputs": np.zeros(20), "measurements": Z}, "inputs and measurements must have shapes"),
        (
            {"inputs": U, "measurements": np.stack([Z, Z], axis=1)},
            r"measurements of one trajectory must have shape \(K \+ 1, 1\), but got \(40, 2\)$",
        ),
        ({"inputs": 0.5, "measurements": Z}, r"shape \(39, 1\), but got a number: np.full\(\(39, 1\), 0.5\)"),
        (
            {"inputs": U, "measurements": Z, "update_first": False},
            r"inputs must have shape \(40, 1\), a row for each .* update_first=False, but got \(39, 1\)",
        ),
        *(
            (
                {
                    "inputs": np.zeros(39 + before),
                    "measurements": np.where(np.arange(40) == 7, np.inf, Z),
                    "update_first": not before,
                },
                "measurements finite or NaN, but row 7 of measurements has inf",
            )
            for before in (0, 1)
        ),
        (
            {"inputs": np.append(np.zeros(38), np.nan), "measurements": Z},
            "inputs must be finite, .* but row 38 of inputs has nan",
        ),
        ({"inputs": U, "measurements": ["a"] * 40}, "measurements must be an array of numbers"),
        ({}, "measurements must be an array"),
        ({**DRIVEN, "dt": 0.1, "noise": 0.3}, "noise must be a function of a step"),
        (
            {**DRIVEN, "dt": 0.1, "noise": lambda dt: np.eye(2), "process_noise_covs": np.zeros((39, 2, 2))},
            "in place of process_noise_covs, but got process_noise_covs, too",
        ),
        ({"keys": Z, "inputs": U}, r"got None: .*run\(filter_, inputs=u, measurements=z\)"),
        ({"keys": []}, r"at least one row, but got \[\]"),
        ({"keys": [[1.0, 2.0], [3.0]]}, "measurements must be an array of numbers"),
        ({"keys": np.stack([Z, Z])}, r"got \(2, 40\): z\[..., None\] for 2 trajectories"),
        ({"keys": Z[None]}, r"got \(1, 40\): z.T"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        filters.run(driven(), **arguments)


def test_a_column_for_each_row_as_filterpy_has_it_is_one_trajectory(walk):
    plain = filters.run(walk, Z)
    for z in (Z[:, None, None], [np.array([[value]]) for value in Z]):
        np.testing.assert_array_equal(filters.run(walk, z).means, plain.means)
    u, z = np.cos(np.arange(39.0)), np.stack([Z, 0.5 * Z], axis=1)
    of_columns = filters.run(driven(2), inputs=u[:, None, None], measurements=z[..., None])
    np.testing.assert_array_equal(of_columns.means, filters.run(driven(2), inputs=u, measurements=z).means)
    assert filters.run(walk, np.zeros((3, 2)), None, Z[:3, None, None]).means.shape == (3, 1, 2)  # with keys


def test_what_is_no_filter_is_refused_with_the_way_to_one(walk):
    for value, way in ((walk.model, "model makes one of it"), ("kf", "makes one"), (None, "makes one")):
        with pytest.raises(ValueError, match="filter_ must be a filter, but got") as error:
            filters.run(value, Z)
        assert way.split(" ")[-1] in str(error.value) and "make_filter" in str(error.value)
    with pytest.raises(ValueError, match="model must be a model, but got 'constant:drift=1,R=1'"):
        filters.make_filter("kf", "constant:drift=1,R=1")
    column = filters.affine_model(
        F=np.eye(2), H=[[1.0, 0.0]], Q=[1.0, 1.0], R=[1.0], x0=[[3.0], [4.0]], P0=np.eye(2)
    )
    assert column.prior_mean.tolist() == [3.0, 4.0]


def test_an_index_of_times_gives_the_steps(walk):
    pandas = pytest.importorskip("pandas")
    plain = filters.run(walk, Z)
    for index in (pandas.date_range("2026-01-01", periods=40, freq="100ms"), 1.7e9 + 0.1 * np.arange(40.0), None):
        np.testing.assert_array_equal(filters.run(walk, pandas.Series(Z, index=index)).means, plain.means)
    stamped = np.round(np.arange(40.0) / 30.0, 3)  # to a millisecond
    thirty = filters.make_filter("kf", walk.model.replace(dt=1.0 / 30.0))
    assert filters.run(thirty, pandas.Series(Z, index=stamped)).data.times[-1] == pytest.approx(39.0 / 30.0)
    series = pandas.Series(Z, index=pandas.date_range("2026-01-01", periods=40, freq="100ms"))
    with pytest.raises(ValueError, match=r"for steps of 0.1 s and a step of 0.3 s: .*z.asfreq"):
        filters.run(walk, series.drop(series.index[[7, 8]]))
    with pytest.raises(ValueError, match=r"for steps of 0.1 s and a step of 5 s"):
        filters.run(walk, Z, dt=5.0)
    holes = pandas.Series(Z).drop([7, 8])
    for function in (lambda z: filters.run(walk, z), lambda z: tuning.fit(z, model="constant", dt=0.1)):
        with pytest.raises(ValueError, match="whole numbers must be equal steps, but 9 follows 6: z.reindex"):
            function(holes)
        for index in (np.arange(40)[::-1], -0.1 * np.arange(40), np.append(np.arange(20), np.arange(20))):
            with pytest.raises(ValueError, match="index of numbers must increase, but .* follows .*z.sort_index"):
                function(pandas.Series(Z, index=index))
    depth = pandas.Index(np.arange(40.0)[::-1], name="depth [m]")  # is no time
    np.testing.assert_array_equal(filters.run(walk, pandas.Series(Z, index=depth)).means, plain.means)
    with pytest.raises(ValueError, match="times of the index must increase, but row 1 comes -0.1 s later"):
        filters.run(walk, series[::-1])


def test_missing_rows_of_an_index_are_long_steps_of_a_filter_that_can(as_python):
    pandas = pytest.importorskip("pandas")
    from filters.plants import pendulum

    ekf = filters.make_filter("ekf", pendulum().at(0.05))
    z = pandas.Series(0.1 * Z[:9], index=pandas.date_range("2026-01-01", periods=9, freq="50ms"))
    z, u = z.drop(z.index[[4, 5]]), np.zeros(6)
    steps = [0.05, 0.05, 0.05, 0.15, 0.05, 0.05]
    for function in (filters.run, filters.smooth):
        of_index = function(ekf, inputs=u, measurements=z)
        by_hand = function(ekf, inputs=u, measurements=z.to_numpy(), dt=steps)
        np.testing.assert_allclose(of_index.means, by_hand.means, rtol=1e-12)
    late = filters.run(ekf, inputs=np.zeros(7), measurements=z, update_first=False)
    assert late.data.times.tolist() == pytest.approx(np.cumsum([0.05, *steps]))


def test_a_run_prints_few_lines_and_a_batch_is_one_table(walk):
    text = str(filters.run(walk, Z))
    assert text.startswith("Estimates of kf: 40 rows, 0 to 3.9 s\n  last position ") and text.count("\n") == 4
    batch = filters.run(walk, np.stack([Z, 2.0 * Z])[..., None])
    assert str(batch).startswith("Estimates of kf: 2 trajectories of 40 rows each")
    table = batch.to_frame()
    assert table.index.names == ["run", "time_s"] and table.loc[1].equals(batch.to_frame(1))
    assert batch.plot(1).axes and "FilteredRuns(" in repr(batch._replace(divergences=0))


def random_data(model, count=3, steps=7):
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, steps, model.inputs)), rng.normal(size=(count, steps + 1, model.m))


@pytest.mark.parametrize("kind, numbers", [(KalmanFilter, {}), (EnsembleKalmanFilter, {"ensemble_size": 5})])
def test_keys_are_those_of_the_first_seeds_unless_they_are_given(kind, numbers, as_python):
    model = wide_model()
    filter_, (u, z) = kind(model=model, **numbers), random_data(model)
    given = run(filter_, filter_keys(range(3)), u, z)
    each_equal(given, run(filter_, inputs=u, measurements=z))
    smoothed = smooth(filter_, filter_keys(range(3)), u, z, 2), smooth(filter_, inputs=u, measurements=z, lag=2)
    np.testing.assert_array_equal(smoothed[0].means, smoothed[1].means)


def test_no_keys_are_made_for_a_filter_that_draws_nothing(as_python, monkeypatch):
    def refuse(seeds):
        raise AssertionError(seeds)

    monkeypatch.setattr("filters.engine.batch.filter_keys", refuse)
    model = wide_model()
    u, z = random_data(model)
    assert np.isfinite(run(KalmanFilter(model=model), inputs=u, measurements=z).means).all()
    with pytest.raises(AssertionError, match=r"range\(0, 3\)"):
        run(EnsembleKalmanFilter(model=model, ensemble_size=5), inputs=u, measurements=z)


def test_a_model_without_inputs_needs_none(as_python):
    noise = {"process_noise_cov": [0.1], "measurement_noise_cov": [1.0], "prior_mean": [0.0], "prior_cov": [1.0]}
    filter_ = KalmanFilter(model=affine_model(a=[[0.9]], b=np.zeros((1, 0)), c=[[1.0]], **noise))
    z = random_data(filter_.model)[1]
    whole = run(filter_, filter_keys(range(3)), np.zeros((3, 7, 0)), z)
    np.testing.assert_array_equal(whole.means, run(filter_, measurements=z).means)


def test_measurements_have_to_be_given(as_python):
    filter_ = KalmanFilter(model=wide_model())
    refused(r"measurements must be an array \(B, K \+ 1, m\), but got None", run, filter_)
    refused("inputs and measurements must have shapes", run, filter_, measurements=random_data(filter_.model)[1])
