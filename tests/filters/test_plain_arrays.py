"""A single trajectory without the axis of a batch: `run(filter_, z)`, lists, pandas, and inputs of each row."""

import numpy as np
import pytest

import filters
from filters.models import kalman_filter


@pytest.fixture(scope="module")
def walk():
    return kalman_filter("constant-velocity", dt=0.1, noise=0.25, acceleration=0.04)


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


def each_equal(single, batch):
    assert type(single) is type(batch)
    for array, part in zip(single, batch, strict=True):
        np.testing.assert_array_equal(array, part[0])


@pytest.mark.parametrize("form", [list, np.array, lambda z: z[:, None]])
def test_a_column_is_a_batch_of_one(walk, form):
    batch = filters.run(walk, inputs=np.zeros((1, 39, 0)), measurements=Z[None, :, None])
    single = filters.run(walk, form(Z))
    each_equal(single, batch)
    assert single.means.shape == (40, 2) and single.innovations.shape == (40, 1)
    assert single.stds[3, 1] == pytest.approx(np.sqrt(single.covs[3, 1, 1])) and single.stds.shape == (40, 2)
    each_equal(
        filters.smooth(walk, form(Z)),
        filters.smooth(walk, inputs=np.zeros((1, 39, 0)), measurements=Z[None, :, None]),
    )


def test_pandas_columns_and_tables(walk):
    pandas = pytest.importorskip("pandas")
    each_equal(filters.run(walk, pandas.Series(Z)), filters.run(walk, Z[None, :, None]))
    table = pandas.DataFrame({"a": Z, "b": 0.5 * Z})
    u = 0.1 * np.arange(39.0)
    batch = filters.run(driven(2), inputs=u[None, :, None], measurements=table.to_numpy()[None])
    each_equal(filters.run(driven(2), inputs=pandas.Series(u), measurements=table), batch)


def test_an_input_of_the_last_row_moves_nothing():
    u = np.cos(np.arange(40.0))
    batch = filters.run(driven(), inputs=u[None, :-1, None], measurements=Z[None, :, None])
    for inputs in (u, u[:-1], u[:, None], u.tolist()):
        each_equal(filters.run(driven(), inputs=inputs, measurements=Z), batch)
    assert not np.array_equal(filters.run(driven(), inputs=u[::-1], measurements=Z).means, batch.means[0])


def test_many_runs_of_measurements_alone(walk):
    z = np.stack([Z, 2.0 * Z])[..., None]
    together = filters.run(walk, z)
    assert together.means.shape == (2, 40, 2)
    np.testing.assert_array_equal(together.means[0], filters.run(walk, Z).means)


def test_an_ensemble_draws_as_the_batch_of_one_does():
    enkf = filters.make_filter("enkf", driven().model, ensemble_size=20)
    u = np.zeros(39)
    each_equal(
        filters.run(enkf, inputs=u, measurements=Z), filters.run(enkf, None, u[None, :, None], Z[None, :, None])
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"keys": Z}, "a model with 1 input must get it"),
        ({"inputs": np.zeros(20), "measurements": Z}, "inputs and measurements must have shapes"),
        (
            {"inputs": np.zeros(39), "measurements": np.stack([Z, Z], axis=1)},
            "inputs and measurements must have shapes",
        ),
        ({"inputs": np.zeros(39), "measurements": ["a"] * 40}, "measurements must be an array of numbers"),
        ({}, "measurements must be an array"),
        (
            {"inputs": np.zeros(39), "measurements": Z, "dt": 0.1, "noise": 0.3},
            "noise must be a function of a step",
        ),
        (
            {
                "inputs": np.zeros(39),
                "measurements": Z,
                "dt": 0.1,
                "noise": lambda dt: np.eye(2),
                "process_noise_covs": np.zeros((39, 2, 2)),
            },
            "in place of process_noise_covs, but got process_noise_covs, too",
        ),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        filters.run(driven(), **arguments)
