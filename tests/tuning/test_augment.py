"""A constant as a state in a study: the problem, its name, the tuned file and all that read it."""

import pickle

import numpy as np
import pytest

import tuning
from filters import EstimateState, Unknown, augmented_model, make_filter
from filters.tuned_file import AUGMENTED, read_tuned_file
from tests.filters.checks import refused
from tests.models import scalar_model
from tuning.evaluation.tuned import read_tuned
from tuning.policies.setup import make_configuration
from tuning.problems.assumed import AugmentedProblem, augmented, name_and_unknown, unknowns_of
from tuning.problems.find import find_given, find_problem
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter

FLOW = {"ambient_velocity": Unknown(0.4, 0.01)}
NAME = "ambient+ambient_velocity:0.4:0.01"
quiet = {"progress": False}


@pytest.fixture(scope="module")
def study():
    problem = tuning.find_problem("ambient", augment={"ambient_velocity": (0.4, 0.01)})
    return tuning.tune(problem, trials=4, **quiet)


@pytest.fixture(scope="module")
def file(study, tmp_path_factory):
    return study.save(tmp_path_factory.mktemp("augmented") / "flow.json")


def test_its_model_data_and_score_are_those_of_its_parts():
    plain, found = find_problem("ambient"), find_problem(NAME)
    assert isinstance(found, AugmentedProblem) and found.name == NAME
    made = augmented_model(plain.model(process_noise_cov=(2.0, 3e-4)), {"ambient_velocity": Unknown(0.4, 0.3)})
    model = found.model(process_noise_cov=(2.0, 3e-4, 0.09), prior_cov_factor=2.0)
    np.testing.assert_allclose(model.process_noise_cov, made.process_noise_cov, rtol=1e-14)
    np.testing.assert_allclose(model.prior_cov, 2.0 * made.prior_cov, rtol=1e-14)
    assert found.untuned["process_noise_cov"] == (*plain.untuned["process_noise_cov"], pytest.approx(1e-4))
    assert found.true["process_noise_cov"] == (*plain.true["process_noise_cov"], pytest.approx(1e-4))
    data, other = plain.data((3, 4)), found.data((3, 4))
    np.testing.assert_array_equal(data.measurements, other.measurements)
    assert found.scale == plain.scale and found.digest != plain.digest
    assert found.digest == augmented(plain, FLOW).digest != augmented(plain, {"ambient_velocity": None}).digest
    assert pickle.loads(pickle.dumps(found)).digest == found.digest


@pytest.mark.parametrize(
    "text, plain, unknown",
    [
        ("mismatch", "mismatch", {}),
        ("mismatch+voltage_gain", "mismatch", {"voltage_gain": None}),
        ("a:b+k:1e+2:.5+c:1:0:-3.5", "a:b", {"k": Unknown(100.0, 0.5), "c": Unknown(1.0, 0.0, -3.5)}),
        ("a+b.toml", "a+b.toml", {}),
        ("run1.csv+2", "run1.csv+2", {}),
    ],
)
def test_a_name_says_which_constants_are_states(text, plain, unknown):
    assert name_and_unknown(text) == (plain, unknown)


@pytest.mark.slow
def test_a_study_is_found_by_its_name_and_estimates_the_flow(study):
    """On `ambient` the filter does not know the flow: with it as a state the error is significantly lower."""
    assert find_given(NAME, (), "a study").digest == study.problem.digest
    plain = tuning.tune("ambient", trials=4, **quiet)
    both = tuning.compare([study, plain], find_problem("ambient"), seeds=20, **quiet)
    (board,) = both.boards
    assert board.rows[1].score_ratio.low > 1.2


@pytest.mark.filterwarnings("ignore:.* was tuned for flow")  # the log's thruster is in still water
def test_every_reader_of_the_file_makes_the_same_filter(study, file, tmp_path, thruster):
    kept = read_tuned_file(file)
    assert kept["problem"] == NAME and kept["filter"]["model"][AUGMENTED] == {"ambient_velocity": [0.4, 0.01, 0.0]}
    choice, problem, _ = read_tuned(file)
    assert problem.digest == study.problem.digest and choice.model == study.choice.model
    expected = make_filter("ekf", problem.model(**choice.model))

    env = EstimateState(problem.make_env(), tuned=str(file))
    assert env.filter.model.digest == expected.model.digest
    np.testing.assert_allclose(env.filter.model.process_noise_cov, expected.model.process_noise_cov, rtol=1e-14)
    env.reset(seed=1)
    assert env.step(env.action_space.sample())[-1]["estimate"].shape == (3,)

    same = tuning.evaluate(file, seeds=5, **quiet).comparison.tuned.score
    assert tuning.evaluate(file, "ambient", seeds=5, **quiet).comparison.tuned.score == same
    (board,) = tuning.compare([str(file), "ekf"], "ambient", seeds=5, **quiet).boards
    assert board.rows[0].evaluation.score == same
    log, out = tmp_path / "run.csv", tmp_path / "estimates.csv"
    thruster("verify", file)
    thruster("simulate", "--steps", "80", "--out", log)
    thruster("estimate", log, file, "--out", out)
    thruster("export", file, "--out", tmp_path / "c")
    assert "ambient_velocity,std_ambient_velocity" in out.read_text().splitlines()[0]
    with pytest.raises(ValueError, match="must have the plant's states, but .* has constants as states"):
        make_configuration("tracking", find_problem("ambient"), "ekf", tuned=file)


def test_constants_without_a_name_and_parameters_of_ones_own_are_refused():
    plain, own = affine_pair(), affine_pair(parameters=[Parameter("q", 0.1, 1.0)])
    refused("a constant to estimate must be one of", augmented, plain, {"stiffness": None})
    refused("asked of a problem that tunes Q and R, but pair tunes q", augmented, own, {"stiffness": None})
    refused("NAME:STD:WALK:MEAN, but got 'k:soft'", unknowns_of, "k:soft")


def affine_pair(**options):
    def model(q=0.5):
        return scalar_model(process_noise_cov=[q])

    return ModelProblem(model(), model if options else None, [0.0] * 60, scale=(1.0,), name="pair", **options)
