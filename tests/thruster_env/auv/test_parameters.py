import math

import numpy as np
import pytest

from tests.thruster_env.auv.textbook import random_states, without_drag_and_lift
from thruster_env.auv.parameters import (
    LAUV,
    PRESETS,
    REMUS100,
    REMUS100_PRESTERO,
    REMUS_SIZES,
    SEGOROGENI,
    VehicleParameters,
    checked,
    derive_constants,
    forces,
    lamb_factors,
    mass_matrix,
    preset_parameters,
    recipe,
)

every_preset = pytest.mark.parametrize("k", PRESETS.values(), ids=PRESETS)

SEGOROGENI_TABLE = """
m 15 W 147.15 B 147.15 zG 0.02 Ix 0.053016 Iy 0.746808 Iz 0.746808
Xud -0.834351 Yvd -13.4984 Zwd -13.4984 Kpd -0.0159048 Mqd -0.534056 Nrd -0.534056 Yrd 0 Zqd 0 Mwd 0 Nvd 0
Xuu -2.84531 Xwq -13.4984 Xvr 13.4984 Xqq 0 Xrr 0
Yvv -84.6178 Yrr 0.536644 Yuv -33.1606 Yur 6.27646 Ywp 13.4984 Ypq 0 Yuudr 16.9305
Zww -84.6178 Zqq -0.536644 Zuw -33.1606 Zuq -6.27646 Zvp -13.4984 Zrp 0 Zuuds -16.9305
Kpp -0.0020033 Kup -0.256294
Mww 1.27772 Mqq -1.85468 Muw 3.16736 Muq -2.98654 Mrp 0.518151 Mvp 0 Muuds -7.11081
Nvv -1.27772 Nrr -1.85468 Nuv -3.16736 Nur -2.98654 Npq -0.518151 Nwp 0 Nuudr -7.11081
""".split()


def test_the_recipe_gives_the_documented_set():
    for name, value in zip(SEGOROGENI_TABLE[::2], SEGOROGENI_TABLE[1::2], strict=True):
        assert getattr(SEGOROGENI, name) == pytest.approx(float(value), rel=5e-6, abs=1e-9), name


def test_lamb_factors_are_those_of_a_sphere_and_of_a_needle_at_the_ends():
    np.testing.assert_allclose(lamb_factors(1.001, 1.0), (0.5, 0.5, 0.0), atol=1e-3)
    np.testing.assert_allclose(lamb_factors(1000.0, 1.0), (0.0, 1.0, 1.0), atol=1e-4)
    np.testing.assert_allclose(lamb_factors(0.49, 0.094), (0.0556, 0.8999, 0.7151), atol=5e-5)


@every_preset
def test_mass_matrices_are_symmetric_and_positive_definite(k):
    matrix = mass_matrix(k)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix)[0] > 0.05


def test_the_mass_matrix_has_the_documented_eigenvalues():
    eigenvalues = np.linalg.eigvalsh(mass_matrix(SEGOROGENI))
    np.testing.assert_allclose(eigenvalues, [0.0658, 1.275, 1.281, 15.84, 28.50, 28.50], rtol=1e-3)
    assert eigenvalues[-1] / eigenvalues[0] == pytest.approx(433, rel=2e-3)


@every_preset
def test_forces_of_inertia_do_no_work(k):
    c = derive_constants(without_drag_and_lift(k))
    for x in random_states(50)[0][:, :6]:
        force = forces(tuple(x), (0.1, -0.4, 0.9), (0.0,) * 4, c)
        assert abs(x @ force) < 1e-13 * np.abs(x * force).sum()


def stability(k):
    """Positive for a vehicle that keeps a straight course."""
    return k.Yuv * k.Nur - k.Nuv * (k.Yur - k.m)


def test_directional_stability_has_the_documented_sign_and_size():
    assert stability(SEGOROGENI) == pytest.approx(71, abs=0.5)
    assert stability(REMUS100) == pytest.approx(215, abs=0.5)
    assert stability(REMUS100_PRESTERO) == pytest.approx(-549, abs=0.5)


def test_remus_by_the_recipe_is_near_the_printed_one():
    k = recipe(REMUS_SIZES._replace(fins=1.0))
    found = [getattr(k, name) for name in "Xud Yvd Mqd Iy Ix Xuu Yvv Mqq Mww Yuudr Nuudr Yuv Yur Muw Muq".split()]
    expected = [-1.10, -28.4, -2.22, 2.75, 0.111, -1.67, -117, -6.6, 2.45, 10.7, -6.8, -33.2, 5.71, 16.0, -4.3]
    np.testing.assert_allclose(found, expected, rtol=0.015)
    for name in ("Xuu", "Yvv", "Zww", "Yuudr", "Zuuds", "Nuudr", "Muuds", "Yuv", "Zuw", "Yur", "Zuq"):
        assert getattr(k, name) == pytest.approx(getattr(REMUS100_PRESTERO, name), rel=0.2)
    for name, value in k._asdict().items():  # of one sign wherever both have a value
        assert value * getattr(REMUS100_PRESTERO, name) >= 0


# A^-1 of Ngatini, Nurhadi (2019), equation (19), A the mass matrix with each row divided by its diagonal; "-08641"
# is read as -0.8641. Its inverse has a diagonal of ones to 8e-4 and the zeros of such a matrix, so the print holds
# what was meant. But its entries imply Xud = Yvd = Zwd, Ix - Kpd < 0 and Iy - Mqd = 0.09 kg m^2 for a body of 15
# kg and almost a metre, and eigenvalues -0.24 and -0.49: an indefinite mass matrix, of which no vehicle has one.
PRINTED_INVERSE = [
    [0.162, -0.0024, 0.8989, 0.0011, 0.098, 0.0001],
    [-0.0012, -0.8175, -0.0206, -0.0431, -0.0024, 0.0969],
    [1.8855, -0.0418, -1.023, -0.0036, -0.2205, 0.0024],
    [-0.0518, 0.8865, 0.0511, 1.0468, 0.0088, -0.105],
    [15.9131, -0.3634, -17.0743, -0.0425, -1.8611, 0.0213],
    [-0.0128, 15.7327, 0.1966, 0.8288, 0.024, -0.8641],
]


def test_the_printed_inverse_has_the_pattern_of_a_mass_matrix_and_is_no_vehicle():
    scaled = np.linalg.inv(PRINTED_INVERSE)
    np.testing.assert_allclose(np.diag(scaled), 1.0, atol=8e-4)
    pattern = mass_matrix(SEGOROGENI._replace(xG=0.01, yG=0.02)) != 0
    assert np.abs(scaled[~pattern]).max() < 0.02 and np.abs(scaled[pattern]).min() > 1e-3
    eigenvalues = np.sort(np.linalg.eigvals(scaled).real)
    np.testing.assert_allclose(eigenvalues, [-0.49, -0.24, 1.0, 1.0, 2.24, 2.49], atol=0.01)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"Mqd": 2.0}, "the mass matrix must be positive definite, but got the smallest eigenvalue -1.25"),
        ({"m": 0.0}, "m must be positive, but got 0.0"),
        ({"Ix": -0.1}, "Ix must be zero or positive, but got -0.1"),
        ({"yG": 0.1}, "yG must be 0 (a centre of gravity amidships), but got 0.1"),
        ({"Yuv": math.nan}, "Yuv must be a finite number, but got nan"),
        ({"Yuv": 1e10}, "Yuv must be within plus and minus 1e+09, but got 10000000000.0"),
    ],
)
def test_what_is_no_vehicle_is_refused_in_a_line(changes, message):
    with pytest.raises(ValueError) as error:
        checked(SEGOROGENI._replace(**changes))
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_a_preset_is_a_name_a_mapping_or_parameters():
    given = LAUV._asdict()
    assert preset_parameters("lauv") == preset_parameters(given) == preset_parameters(LAUV) == LAUV
    without = {name: value for name, value in given.items() if name not in VehicleParameters._field_defaults}
    assert preset_parameters(without).Yv == 0.0
    with pytest.raises(ValueError, match="preset must be one of segorogeni, .*, but got 'submarine'"):
        preset_parameters("submarine")
    with pytest.raises(ValueError, match="fields of VehicleParameters, but lacks B, m and got mass"):
        preset_parameters({"mass": 1.0} | {name: value for name, value in given.items() if name not in ("m", "B")})
