"""The parameters that Ngatini and Nurhadi (2019) print for their vehicle, for reference and not for simulation."""

from __future__ import annotations

import numpy as np

PRINTED_INVERSE = np.array(
    [
        [0.162, -0.0024, 0.8989, 0.0011, 0.098, 0.0001],
        [-0.0012, -0.8175, -0.0206, -0.0431, -0.0024, 0.0969],
        [1.8855, -0.0418, -1.023, -0.0036, -0.2205, 0.0024],
        [-0.0518, 0.8865, 0.0511, 1.0468, 0.0088, -0.105],
        [15.9131, -0.3634, -17.0743, -0.0425, -1.8611, 0.0213],
        [-0.0128, 15.7327, 0.1966, 0.8288, 0.024, -0.8641],
    ]
)
"""A^-1 of equation (19), A the mass matrix with each row divided by its diagonal; "-08641" is read as -0.8641.

Its inverse has a diagonal of ones to 8e-4 and the zeros of such a matrix, so the print holds what was meant. But
its entries imply Xud = Yvd = Zwd, Ix - Kpd < 0 and Iy - Mqd = 0.09 kg m^2 for a body of 15 kg and almost a
metre, and eigenvalues -0.24 and -0.49: an indefinite mass matrix, of which no vehicle has one.
"""
