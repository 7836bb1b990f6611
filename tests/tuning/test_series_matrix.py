"""Matrices as the answer of a fit prints them."""

import numpy as np

from tuning.series.answer import _matrix


def test_each_number_has_six_digits():
    assert _matrix(np.array([[0.000151234567, 2.0], [1e-9 / 3.0, 12.3456789]]), "") == (
        "[[0.000151235, 2],\n [3.33333e-10, 12.3457]]"
    )
