"""A plant of another package has scenarios by name and by file, as the plants of this one."""

from importlib.metadata import EntryPoint

import numpy as np
import pytest

from tuning.problems import find
from tuning.problems.check import checked_problem
from tuning.problems.find import find_problem, plant_packages, scenario_of
from tuning.search.space import untuned_choice

pytestmark = pytest.mark.usefixtures("as_python")


@pytest.fixture
def brought(monkeypatch):
    """Bring modules by entry points."""

    def bring(**modules):
        points = [EntryPoint(name, module, find.PLANTS) for name, module in modules.items()]
        monkeypatch.setattr(find, "entry_points", lambda group: points)
        plant_packages.cache_clear()

    yield bring
    plant_packages.cache_clear()


def test_scenarios_of_another_package_are_found_by_name_by_file_and_in_tuned_files(brought, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="problem must be one of"):
        find_problem("cart")
    brought(cart="tests.cart_scenarios")
    scenario = checked_problem(find_problem("cart"))
    assert scenario.untuned["process_noise_cov"] == pytest.approx((4e-4, 4e-4, 1.6e-3))
    assert scenario.plant_data == {"mass": 2.0} and scenario.plant_arguments == {"mass": 2.0, "dt": 0.1}
    assert scenario_of(scenario.as_mapping(), "cart", "tuned.json").digest == scenario.digest
    assert untuned_choice("kf", scenario).filter(scenario).model.measurement_noise_cov[1, 1] == 0.04
    monkeypatch.chdir(tmp_path)
    (tmp_path / "heavy.toml").write_text(
        'plant = "cart"\nmass = 4.0\nparameter_factors = {mass = 0.5}\nsteps = 60'
    )
    heavy = find_problem("heavy.toml")
    assert heavy.model().constants == scenario.model().constants and heavy.plant.mass == 4.0
    assert heavy.scale_about == "the scale given with the problem" and np.isfinite(heavy.scale).all()
    with pytest.raises(ValueError, match="plant of a scenario must be one of thruster, auv, cart, but got 'ship'"):
        scenario_of({"plant": "ship"}, "x", "tuned.json")


def test_a_module_that_brings_no_plant_is_left_out_with_a_warning(brought):
    brought(none="tests.small_plant", gone="tests.nowhere", cart="tests.cart_scenarios")
    with pytest.warns(UserWarning, match="must offer Scenario, SCENARIOS and NOMINAL, but tests") as caught:
        assert set(plant_packages()) == {"thruster", "auv", "cart"}
    assert len(caught) == 2
