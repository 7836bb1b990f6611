import numpy as np
import pytest

from benchmarks import studies
from benchmarks.__main__ import command
from benchmarks.batches import NORMALS, array_filter
from filters import EnsembleKalmanFilter, thruster_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, fill_normals
from thruster_env.thruster.plant import make_plant


@pytest.mark.slow
def test_the_quick_benchmark_measures_the_rows_of_parts():
    """Of those with other packages and machine code of C; a study takes minutes."""
    pytest.importorskip("filterpy")
    found = command(quick=True, part=["steps", "trajectories", "c_code"]).data
    rows = found["rows"]
    assert not found["failed"]
    assert len(rows) >= 9
    assert all(row["ours_seconds"] > 0 for row in rows)
    assert {"FilterPy", "FilterPy's UKF", "FilterPy's KF"} < {row["peer"] for row in rows}
    assert any(row["peer"] in ("JAX", "JAX is not installed") for row in rows)


@pytest.mark.parametrize("process_noise_cov", [[1.0, 4e-4], [[1.0, 0.01], [0.01, 4e-4]]])
def test_the_filter_written_for_jax_is_ours_given_our_random_numbers(process_noise_cov):
    size, key, arguments = 64, (7, 11), {"process_noise_cov": process_noise_cov}
    plant = make_plant(**arguments)
    peer, ours = (
        array_filter(plant, np),
        EnsembleKalmanFilter(model=thruster_model(**arguments), ensemble_size=size),
    )

    def normals(step, of_states):
        states, measurement = np.zeros(2 * size), np.zeros(size)
        fill_normals(states, len(states), step, of_states, *key)
        fill_normals(measurement, size, step, FILTER_MEASUREMENT, *key)
        return np.concatenate([states, measurement]).reshape(NORMALS, size)

    with interpreted():
        belief, _ = ours.update(ours.init(key), [3.0])
        members = peer.start(normals(0, FILTER_PRIOR), 3.0)
        for step in range(1, 6):
            voltage, z = 20.0 - 8.0 * step, 15.0 * step
            belief, _ = ours.update(ours.predict(belief, [voltage]), [z])
            members = peer.step(members, voltage, normals(step, FILTER_PROCESS), z)
        mean, cov = peer.moments(members)
    np.testing.assert_allclose(mean, belief.mean, rtol=1e-9)
    np.testing.assert_allclose(cov, belief.cov, rtol=1e-9)


def test_what_a_study_spends_in_filters_is_timed_where_it_calls_them():
    for module, names in studies.FILTERS_AND_SCORES.items():
        assert all(callable(getattr(module, name)) for name in names)
