import optuna
import pytest

from filters.registry import FILTERS
from tuning.experiments import lorenz63
from tuning.plants.thruster import find_scenario
from tuning.search.parameters import size_ladder
from tuning.search.plan import Plan
from tuning.search.space import choice_of, distributions, parameters_of, trial_parameters, untuned_choice
from tuning.search.study import open_study

NOMINAL = find_scenario("nominal")


@pytest.mark.parametrize("name", FILTERS)
def test_a_choice_survives_its_trial_parameters(name):
    choice = untuned_choice(name, NOMINAL)
    assert choice_of(name, parameters_of(choice), NOMINAL) == choice
    assert choice.filter(NOMINAL).name == name


@pytest.mark.parametrize(("name", "size"), [("enkf", 30), ("ienkf", 30), ("pf", 1000), ("rbpf", 100)])
def test_particle_filters_have_sizes_of_their_own(name, size):
    assert untuned_choice(name, NOMINAL).numbers["ensemble_size"] == size
    ladder = size_ladder(name)
    assert (ladder[0], ladder[-1]) == {30: (5, 200), 100: (20, 1000), 1000: (200, 5000)}[size] and size in ladder


@pytest.mark.parametrize("name", ["pf", "apf"])
def test_particles_are_regularised_by_a_study_where_there_is_no_process_noise(name):
    untuned, known = untuned_choice(name, lorenz63.problem), untuned_choice(name, NOMINAL)
    assert untuned.numbers["regularisation"] == 0.0 and "regularisation" not in known.numbers
    assert "regularisation" not in distributions(name, NOMINAL)
    space = distributions(name, lorenz63.problem, hold_r=True)
    values = {"N": 300, "regularisation": 1.5} | ({"resampling_threshold": 0.3} if name == "pf" else {})
    choice = choice_of(name, values, lorenz63.problem)
    assert set(space) == set(values) and trial_parameters(choice, space) == values
    assert choice.filter(lorenz63.problem).regularisation == 1.5


def test_baselines_are_not_searched_over_q_and_r():
    assert parameters_of(untuned_choice("open-loop", NOMINAL)) == {}
    assert parameters_of(untuned_choice("low-pass", NOMINAL)) == {"time_constant": 2.0}
    choice = choice_of("low-pass", {"time_constant": 4.0}, NOMINAL)
    assert choice.numbers == {"time_constant": 4.0} and parameters_of(choice) == {"time_constant": 4.0}
    storage = optuna.storages.InMemoryStorage()
    for name in ("open-loop", "inversion"):
        with pytest.raises(ValueError, match=f"filter must have something to tune, but got '{name}'"):
            open_study("s", Plan(name, (NOMINAL,)), storage)
