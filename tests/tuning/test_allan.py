"""The Allan deviation of a sensor at rest: closed forms, intervals, and what is refused."""

import numpy as np
import pytest

from tuning.cli.main import main
from tuning.logs.allan import allan_deviation, flicker_noise, noise_of

DT, COUNT = 0.02, 60_000


def test_closed_forms_of_white_noise_walks_and_flicker():
    """N/sqrt(tau), K sqrt(tau/3) and 0.664 B; a drift at a constant rate R is R tau/sqrt(2)."""
    draws = np.random.default_rng(5).standard_normal((2, COUNT))
    for values, expected in (
        (draws[0] / np.sqrt(DT), lambda tau: 1.0 / np.sqrt(tau)),
        (np.sqrt(DT) * np.cumsum(draws[1]), lambda tau: np.sqrt((tau**2 + DT**2 / 2.0) / (3.0 * tau))),
        (flicker_noise(draws[0]), lambda tau: np.full_like(tau, 0.664)),
        (DT * np.arange(COUNT), lambda tau: tau / np.sqrt(2.0)),
    ):
        taus, deviations = allan_deviation(values, DT)
        some_samples = (taus > 4.0 * DT) & (taus < 10.0)
        np.testing.assert_allclose(deviations[some_samples], expected(taus[some_samples]), rtol=0.12)


def test_the_noise_of_a_record_lies_in_its_intervals():
    rng = np.random.default_rng(3)
    true = {"N": 2e-3, "B": 0.0, "K": 4e-4}
    values = true["N"] / np.sqrt(DT) * rng.standard_normal(COUNT)
    values += true["K"] * np.sqrt(DT) * np.cumsum(rng.standard_normal(COUNT))
    *_, noise = noise_of(values, DT, rng)
    assert noise["N"].value == pytest.approx(2e-3, rel=0.02)
    for name, value in true.items():
        assert noise[name].low <= value <= noise[name].high
    assert noise["K"].low > 0.0


def test_a_log_at_rest_from_the_command_line(tmp_path, monkeypatch, capsys):
    """Start values of the model; a short log and one in motion are refused in a line."""
    rng, path = np.random.default_rng(2), tmp_path / "imu.csv"
    time = np.arange(6_200) / 50.0
    columns = {"time": time} | {f"gyr_{axis}": 2e-4 * np.sqrt(50.0) * rng.standard_normal(6_200) for axis in "xyz"}

    def written(**changes):
        table = columns | changes
        np.savetxt(path, np.column_stack(list(table.values())), delimiter=",", header=",".join(table), comments="")
        return str(path)

    def thruster(*arguments):
        monkeypatch.setattr("sys.argv", ["thruster", "log", *arguments, "--allan"])
        with pytest.raises(SystemExit):
            main()
        return " ".join("".join(capsys.readouterr()).split())

    result = thruster(written(), "--plot", str(tmp_path / "allan.png"))
    assert "--model attitude:gyroscope=0.0002,bias_walk=" in result
    assert (tmp_path / "allan.png").stat().st_size > 10_000
    refused = thruster(written(gyr_z=0.3 * np.sin(0.05 * time)))
    assert "must be at rest, but means of gyr_z over 1 s differ by 0.6 rad/s" in refused
