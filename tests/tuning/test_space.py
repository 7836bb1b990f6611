import optuna
import pytest

from filters.registry import FILTERS
from tuning.search.plan import Plan
from tuning.search.space import choice_of, parameters_of, size_ladder, untuned_choice
from tuning.search.study import open_study
from tuning.thruster.find import find_scenario

NOMINAL = find_scenario("nominal")


@pytest.mark.parametrize("name", FILTERS)
def test_a_choice_survives_its_trial_parameters(name):
    choice = untuned_choice(name, NOMINAL)
    assert choice_of(name, parameters_of(choice), NOMINAL) == choice
    assert choice.filter(NOMINAL).name == name


@pytest.mark.parametrize(("name", "size"), [("enkf", 30), ("ienkf", 30), ("pf", 1000), ("apf", 1000)])
def test_particle_filters_have_sizes_of_their_own(name, size):
    assert untuned_choice(name, NOMINAL).numbers["ensemble_size"] == size
    ladder = size_ladder(name)
    assert (ladder[0], ladder[-1]) == ((5, 200) if size == 30 else (200, 5000)) and size in ladder


def test_baselines_are_not_searched_over_q_and_r():
    assert parameters_of(untuned_choice("open-loop", NOMINAL)) == {}
    assert parameters_of(untuned_choice("low-pass", NOMINAL)) == {"time_constant": 2.0}
    choice = choice_of("low-pass", {"time_constant": 4.0}, NOMINAL)
    assert choice.numbers == {"time_constant": 4.0} and parameters_of(choice) == {"time_constant": 4.0}
    storage = optuna.storages.InMemoryStorage()
    for name in ("open-loop", "inversion"):
        with pytest.raises(ValueError, match=f"filter must be one that has something to tune, but got '{name}'"):
            open_study("s", Plan(name, (NOMINAL,)), storage)
