"""The equations of motion as they are printed, term by term, for any centre of gravity, and random states."""

import numpy as np

from thruster_env.auv.parameters import mass_matrix


def hydrostatics(k, phi, theta):
    """Weight and buoyancy, after Fossen, the centre of buoyancy at the origin."""
    sp, cp, st, ct = np.sin(phi), np.cos(phi), np.sin(theta), np.cos(theta)
    return np.array(
        [
            -(k.W - k.B) * st,
            (k.W - k.B) * ct * sp,
            (k.W - k.B) * ct * cp,
            k.yG * k.W * ct * cp - k.zG * k.W * ct * sp,
            -k.zG * k.W * st - k.xG * k.W * ct * cp,
            k.xG * k.W * ct * sp + k.yG * k.W * st,
        ]
    )


def hydrodynamics(k, nu):
    """Drag, lift and products of velocities of the water, without the planes."""
    u, v, w, p, q, r = nu
    return np.array(
        [
            k.Xu * u + k.Xuu * u * abs(u) + k.Xwq * w * q + k.Xqq * q * q + k.Xvr * v * r + k.Xrr * r * r,
            k.Yv * v + k.Yr * r + k.Yvv * v * abs(v) + k.Yrr * r * abs(r)
            + k.Yur * u * r + k.Ywp * w * p + k.Ypq * p * q + k.Yuv * u * v,
            k.Zw * w + k.Zq * q + k.Zww * w * abs(w) + k.Zqq * q * abs(q)
            + k.Zuq * u * q + k.Zvp * v * p + k.Zrp * r * p + k.Zuw * u * w,
            k.Kp * p + k.Kpp * p * abs(p) + k.Kup * u * p,
            k.Mw * w + k.Mq * q + k.Mww * w * abs(w) + k.Mqq * q * abs(q)
            + k.Muq * u * q + k.Mvp * v * p + k.Mrp * r * p + k.Muw * u * w,
            k.Nv * v + k.Nr * r + k.Nvv * v * abs(v) + k.Nrr * r * abs(r)
            + k.Nur * u * r + k.Nwp * w * p + k.Npq * p * q + k.Nuv * u * v,
        ]
    )  # fmt: skip


def inertial(k, nu):
    """What the brackets on the left of the printed equations hold besides accelerations."""
    u, v, w, p, q, r = nu
    m, x, y, z = k.m, k.xG, k.yG, k.zG
    return np.array(
        [
            m * (-v * r + w * q - x * (q * q + r * r) + y * p * q + z * p * r),
            m * (-w * p + u * r - y * (r * r + p * p) + z * q * r + x * p * q),
            m * (-u * q + v * p - z * (p * p + q * q) + x * r * p + y * r * q),
            (k.Iz - k.Iy) * q * r + m * (y * (-u * q + v * p) - z * (-w * p + u * r)),
            (k.Ix - k.Iz) * r * p + m * (z * (-v * r + w * q) - x * (-u * q + v * p)),
            (k.Iy - k.Ix) * p * q + m * (x * (-w * p + u * r) - y * (-v * r + w * q)),
        ]
    )


def controls(k, nu, inputs):
    """Propeller and planes."""
    thrust, torque, stern, rudder = inputs
    uu = nu[0] ** 2
    return np.array(
        [
            thrust,
            k.Yuudr * uu * rudder,
            k.Zuuds * uu * stern,
            torque,
            k.Muuds * uu * stern,
            k.Nuudr * uu * rudder,
        ]
    )


def accelerations(k, nu, phi, theta, inputs):
    force = hydrostatics(k, phi, theta) + hydrodynamics(k, nu) - inertial(k, nu) + controls(k, nu, inputs)
    return np.linalg.solve(mass_matrix(k), force)


def without_drag_and_lift(k):
    """Inertia and added mass alone: the forces that are left do no work."""
    zero = "Xuu Yvv Yrr Yuv Zww Zqq Zuw Kpp Kup Mww Mqq Nvv Nrr W B Xu Yv Yr Zw Zq Kp Mw Mq Nv Nr".split()
    return k._replace(
        **dict.fromkeys(zero, 0.0),
        Yur=k.Xud,
        Zuq=-k.Xud,
        Muw=-(k.Zwd - k.Xud),
        Muq=-k.Zqd,
        Nuv=-(k.Xud - k.Yvd),
        Nur=k.Yrd,
    )


def random_states(count, seed=0):
    """States (count, 12) and inputs (count, 4), some larger than a vehicle has."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 12)) * [1.0, 0.3, 0.3, 0.5, 0.5, 0.5, 0.5, 0.5, 3.0, 9.0, 9.0, 9.0]
    return x, rng.normal(size=(count, 4)) * [3.0, 0.05, 0.2, 0.2]
