"""What is not finite is not written to a file, nor judged: one line says from which step on."""

import numpy as np
import pytest

from thruster_env.core.streams import episode_keys
from thruster_env.thruster.equations import Simulation, simulate
from thruster_env.thruster.plant import make_plant

WILD = 'base = "nominal"\nprocess_noise_cov = [1e8, 1e8]\nscale = [1.0, 0.05]\n'


@pytest.mark.parametrize("options", [("--out", "run.csv"), ("--out", "run.npz", "--json", "run.json")])
def test_a_simulation_that_is_not_finite_is_refused_and_not_written(options, thruster, tmp_path):
    (tmp_path / "run.csv").write_text("of before")
    done = thruster("simulate", "--process-noise", 1e8, 1e8, *options)
    assert done.returncode == 2 and not done.stdout
    assert "thruster: a simulation must stay finite, but it is not from step " in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]
    assert (tmp_path / "run.csv").read_text() == "of before"


def test_the_step_is_the_first_of_any_run_and_any_number():
    whole = simulate(make_plant(), episode_keys([1, 2]), np.full((2, 6), 3.0))
    assert whole.checked() is whole
    for name, place in (("states", (1, 4, 0)), ("thrusts", (0, 3)), ("measurements", (1, 5, 0))):
        for value in (np.nan, np.inf, -np.inf):
            part = getattr(whole, name).copy()
            part[place] = value
            with pytest.raises(
                ValueError, match=f"a run must stay finite, but it is not from step {place[1]} of 6 on"
            ):
                Simulation(**{**whole._asdict(), name: part}).checked("a run")


@pytest.mark.parametrize(
    "command", [("evaluate", "--filter", "ekf"), ("compare", "--filter", "ekf"), ("tune", "--filter", "ekf")]
)
def test_nothing_is_judged_on_a_plant_that_is_not_finite(command, thruster, tmp_path):
    (tmp_path / "wild.toml").write_text(WILD)
    done = thruster(*command, "--scenario", "wild.toml")
    assert done.returncode == 2 and "nan" not in done.stdout.lower()
    assert "the plant of scenario wild.toml must stay finite, but it is not from step " in done.stderr
