"""The parameters of an underwater vehicle, and the constants of the equations of motion that follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from thruster_env.auv.forces import Constants
from thruster_env.core.checks import positive, within

LARGEST = 1e9  # of any parameter, in units of SI: beyond it floating point may overflow


class VehicleParameters(NamedTuple):
    """Mass, hydrostatics and hydrodynamic coefficients of a slender vehicle with tail fins.

    A coefficient is named by the force or moment that it belongs to, X Y Z [N] or K M N [N m], and by what it
    multiplies: `Yuv` is the factor of u v in the sway force, `Xuu` that of u |u| in the surge force, `Yvd` that of
    dv/dt, `Yuudr` that of u^2 times the rudder's angle. Velocities are u, v, w [m/s] ahead, to starboard and down,
    p, q, r [rad/s] in roll, pitch and yaw. The centre of buoyancy is the origin of the body's axes.

    Those of one velocity alone, such as `Yv`, are zero in the papers and in the recipe's results; `Kup` is our
    addition: see `recipe`. Source of the names: Prestero (2001), "Verification of a six-degree of freedom
    simulation model for the REMUS autonomous underwater vehicle".
    """

    m: float  # mass [kg]
    W: float  # weight [N]
    B: float  # buoyancy [N]
    xG: float  # centre of gravity [m]
    yG: float
    zG: float
    Ix: float  # inertia about the origin [kg m^2]
    Iy: float
    Iz: float
    Xud: float  # added mass and inertia, negative
    Yvd: float
    Yrd: float
    Zwd: float
    Zqd: float
    Kpd: float
    Mwd: float
    Mqd: float
    Nvd: float
    Nrd: float
    Xuu: float  # surge
    Xwq: float
    Xqq: float
    Xvr: float
    Xrr: float
    Yvv: float  # sway
    Yrr: float
    Yuv: float
    Yur: float
    Ywp: float
    Ypq: float
    Yuudr: float
    Zww: float  # heave
    Zqq: float
    Zuw: float
    Zuq: float
    Zvp: float
    Zrp: float
    Zuuds: float
    Kpp: float  # roll
    Kup: float
    Mww: float  # pitch
    Mqq: float
    Muw: float
    Muq: float
    Mvp: float
    Mrp: float
    Muuds: float
    Nvv: float  # yaw
    Nrr: float
    Nuv: float
    Nur: float
    Nwp: float
    Npq: float
    Nuudr: float
    Xu: float = 0.0  # linear damping
    Yv: float = 0.0
    Yr: float = 0.0
    Zw: float = 0.0
    Zq: float = 0.0
    Kp: float = 0.0
    Mw: float = 0.0
    Mq: float = 0.0
    Nv: float = 0.0
    Nr: float = 0.0


def mass_matrix(p: VehicleParameters) -> np.ndarray:
    """M (6, 6) of the rigid body and the water it moves: M d(u, v, w, p, q, r)/dt = forces and moments."""
    m, x, y, z = p.m, p.xG, p.yG, p.zG
    return np.array(
        [
            [m - p.Xud, 0.0, 0.0, 0.0, m * z, -m * y],
            [0.0, m - p.Yvd, 0.0, -m * z, 0.0, m * x - p.Yrd],
            [0.0, 0.0, m - p.Zwd, m * y, -m * x - p.Zqd, 0.0],
            [0.0, -m * z, m * y, p.Ix - p.Kpd, 0.0, 0.0],
            [m * z, 0.0, -m * x - p.Mwd, 0.0, p.Iy - p.Mqd, 0.0],
            [-m * y, m * x - p.Nvd, 0.0, 0.0, 0.0, p.Iz - p.Nrd],
        ]
    )


def checked(parameters: VehicleParameters) -> VehicleParameters:
    """Return the parameters as floats; raise ValueError that names the rule and the value if one is off.

    The kinetic energy, half of nu' M nu, must be positive, so M must be positive definite. The vehicle must be
    alike to port and starboard as far as its mass goes, y_G = 0: M then falls into two blocks.
    """
    values = {}
    for name, value in parameters._asdict().items():
        values[name] = within(name, positive(name, value) if name == "m" else value, LARGEST)
    for name in ("W", "B", "Ix", "Iy", "Iz"):
        positive(name, values[name], zero_allowed=True)
    if values["yG"] != 0.0:
        raise ValueError(f"yG must be 0 (a centre of gravity amidships), but got {values['yG']}")
    result = VehicleParameters(**values)
    matrix = mass_matrix(result)
    smallest = np.linalg.eigvalsh((matrix + matrix.T) / 2)[0]
    if smallest <= 0.0:
        raise ValueError(
            f"the mass matrix must be positive definite, but got the smallest eigenvalue {smallest:.4g}"
        )
    return result


def parameters_of(fields: Mapping) -> VehicleParameters:
    """Parameters from a mapping of all fields but those of linear damping, which may be left out."""
    known, needed = (
        VehicleParameters._fields,
        set(VehicleParameters._fields) - set(VehicleParameters._field_defaults),
    )
    unknown, missing = sorted(map(str, set(fields) - set(known))), sorted(needed - set(fields))
    if unknown or missing:
        faults = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"got {', '.join(unknown)}"] * bool(unknown)
        raise ValueError(f"a preset mapping must have the fields of VehicleParameters, but {' and '.join(faults)}")
    return checked(VehicleParameters(**fields))


def derive_constants(p: VehicleParameters, substep: float = 0.0, propeller_torque: float = 0.0) -> Constants:
    """Constants of the equations of motion for checked parameters.

    Args:
        p: the parameters.
        substep: time step of one integration step [s].
        propeller_torque: the propeller's torque over its thrust [m], where that is no input.
    """
    m, x, z = p.m, p.xG, p.zG
    i = np.linalg.inv(mass_matrix(p)).tolist()
    return Constants(
        heaviness=p.W - p.B, righting=z * p.W, nose_weight=x * p.W,
        x_u=p.Xu, x_uu=p.Xuu, x_wq=p.Xwq - m, x_qq=p.Xqq + m * x, x_vr=p.Xvr + m, x_rr=p.Xrr + m * x, x_pr=-m * z,
        y_v=p.Yv, y_vv=p.Yvv, y_uv=p.Yuv, y_r=p.Yr, y_rr=p.Yrr, y_ur=p.Yur - m, y_qr=-m * z, y_wp=p.Ywp + m,
        y_pq=p.Ypq - m * x, y_uudr=p.Yuudr,
        z_w=p.Zw, z_ww=p.Zww, z_uw=p.Zuw, z_q=p.Zq, z_qq=p.Zqq, z_uq=p.Zuq + m, z_q2=m * z, z_p2=m * z,
        z_vp=p.Zvp - m, z_rp=p.Zrp - m * x, z_uuds=p.Zuuds,
        k_p=p.Kp, k_pp=p.Kpp, k_up=p.Kup, k_wp=-m * z, k_ur=m * z, k_qr=p.Iy - p.Iz,
        m_w=p.Mw, m_ww=p.Mww, m_uw=p.Muw, m_q=p.Mq, m_qq=p.Mqq, m_uq=p.Muq - m * x, m_wq=-m * z, m_vr=m * z,
        m_vp=p.Mvp + m * x, m_rp=p.Mrp + p.Iz - p.Ix, m_uuds=p.Muuds,
        n_v=p.Nv, n_vv=p.Nvv, n_uv=p.Nuv, n_r=p.Nr, n_rr=p.Nrr, n_ur=p.Nur - m * x, n_wp=p.Nwp + m * x,
        n_pq=p.Npq + p.Ix - p.Iy, n_uudr=p.Nuudr,
        **{f"{a}_of_{b}": i[row][column] for row, a in enumerate("uvwpqr") for column, b in _coupled(row)},
        propeller_torque=propeller_torque, substep=substep,
    )  # fmt: skip


def _coupled(row: int) -> list[tuple[int, str]]:
    """The forces and moments that accelerate a velocity: those of its block, (X, Z, M) or (Y, K, N)."""
    return [(column, "XYZKMN"[column]) for column in ((0, 2, 4) if row in (0, 2, 4) else (1, 3, 5))]
