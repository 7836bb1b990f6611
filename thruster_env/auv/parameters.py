"""The parameters of an underwater vehicle, and the constants of the equations of motion that follow from them.

Vehicles by name: sizes and parameters, and where each number is from.

Hull and added mass are those of a prolate spheroid (Lamb); cross-flow drag by strips, the lift of the body by
Hoerner's formula and the lift of the fins follow Prestero (2001), chapter 4, and so do the products of velocities
that come with the added mass.

Two things differ from prints. The moment of the body's lift reduces the Munk moment, as in the values that
Prestero prints (Muw 24.0 = 34.6 - 4.4 - 6.2): a public file of his formulas has the other sign. And the fins'
factors hold for a pair of fins; the values printed for REMUS are half of that (`fins=1`).
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import one_of, positive, within

# Forces and moments on an underwater vehicle, once, and the accelerations that they cause.
#
#     M d nu/dt = F(nu, phi, theta, u)
#
# Velocities nu = (u, v, w, p, q, r) are those through the water in the body's axes: ahead, to starboard and down
# [m/s], in roll, pitch and yaw [rad/s]. Input u = (X_prop, K_prop, delta_s, delta_r): the propeller's thrust [N]
# and torque [N m], the angles of stern plane and rudder [rad]. delta_s > 0 pitches the nose down, delta_r > 0
# turns the vehicle to port.
#
# F is Prestero's (2001), term by term, as Ngatini and Nurhadi (2019) print it; damping of roll by the fins and
# linear damping are added, both zero in the papers. The lift of body and fins goes with u v and u^2: the
# equations hold for a vehicle that goes ahead. Only operators and abs occur, so the same source runs on floats,
# NumPy arrays and torch tensors and compiles with numba.


Constants = namedtuple(
    "Constants",
    "heaviness righting nose_weight "  # W - B [N], z_G W [N m], x_G W [N m]
    "x_u x_uu x_wq x_qq x_vr x_rr x_pr "
    "y_v y_vv y_uv y_r y_rr y_ur y_qr y_wp y_pq y_uudr "
    "z_w z_ww z_uw z_q z_qq z_uq z_q2 z_p2 z_vp z_rp z_uuds "  # z_q2 of q^2, z_qq of q |q|
    "k_p k_pp k_up k_wp k_ur k_qr "
    "m_w m_ww m_uw m_q m_qq m_uq m_wq m_vr m_vp m_rp m_uuds "
    "n_v n_vv n_uv n_r n_rr n_ur n_wp n_pq n_uudr "
    "u_of_X u_of_Z u_of_M v_of_Y v_of_K v_of_N w_of_X w_of_Z w_of_M "
    "p_of_Y p_of_K p_of_N q_of_X q_of_Z q_of_M r_of_Y r_of_K r_of_N "
    "propeller_torque "  # K_prop over X_prop [m], where that is no input
    "substep",  # time step of one integration step [s]
)
"""The constants of the equations; `parameters.derive_constants` computes them from a vehicle.

`y_ur` is the factor of u r in the sway force, the rigid body's m u r included; `u_of_X` is an entry of the inverse
mass matrix, the surge acceleration by a unit of surge force.
"""


def forces(nu, g, inputs, c):
    """Forces X, Y, Z [N] and moments K, M, N [N m] on a vehicle of velocities nu, without those of acceleration.

    g is the direction downwards in the body's axes (`dynamics.down`), inputs = (X_prop, K_prop, delta_s,
    delta_r).
    """
    u, v, w, p, q, r = nu
    thrust, torque, stern, rudder = inputs[0], inputs[1], inputs[2], inputs[3]
    uu = u * u
    surge = u * (c.x_u + c.x_uu * abs(u)) + q * (c.x_wq * w + c.x_qq * q)
    surge = surge + r * (c.x_vr * v + c.x_rr * r + c.x_pr * p) + c.heaviness * g[0] + thrust
    sway = v * (c.y_v + c.y_uv * u + c.y_vv * abs(v)) + r * (c.y_r + c.y_ur * u + c.y_rr * abs(r) + c.y_qr * q)
    sway = sway + p * (c.y_wp * w + c.y_pq * q) + c.y_uudr * uu * rudder + c.heaviness * g[1]
    heave = w * (c.z_w + c.z_uw * u + c.z_ww * abs(w)) + q * (c.z_q + c.z_uq * u + c.z_qq * abs(q) + c.z_q2 * q)
    heave = heave + p * (c.z_p2 * p + c.z_vp * v + c.z_rp * r) + c.z_uuds * uu * stern + c.heaviness * g[2]
    roll = p * (c.k_p + c.k_up * u + c.k_pp * abs(p) + c.k_wp * w) + r * (c.k_ur * u + c.k_qr * q)
    roll = roll - c.righting * g[1] + torque
    pitch = w * (c.m_w + c.m_uw * u + c.m_ww * abs(w)) + q * (c.m_q + c.m_uq * u + c.m_qq * abs(q) + c.m_wq * w)
    pitch = pitch + r * (c.m_vr * v + c.m_rp * p) + c.m_vp * v * p + c.m_uuds * uu * stern
    pitch = pitch + c.righting * g[0] - c.nose_weight * g[2]
    yaw = v * (c.n_v + c.n_uv * u + c.n_vv * abs(v)) + r * (c.n_r + c.n_ur * u + c.n_rr * abs(r))
    yaw = yaw + p * (c.n_wp * w + c.n_pq * q) + c.n_uudr * uu * rudder + c.nose_weight * g[1]
    return surge, sway, heave, roll, pitch, yaw


def forces_tangent(nu, d_nu, dg, inputs, c):
    """Directional derivative of `forces` along (d_nu, dg), by the product rule; the inputs are held."""
    u, v, w, p, q, r = nu
    du, dv, dw, dp, dq, dr = d_nu
    twice_stern, twice_rudder = 2.0 * u * inputs[2], 2.0 * u * inputs[3]
    surge = du * (c.x_u + 2.0 * c.x_uu * abs(u)) + dw * (c.x_wq * q) + dq * (c.x_wq * w + 2.0 * c.x_qq * q)
    surge = surge + dv * (c.x_vr * r) + dr * (c.x_vr * v + 2.0 * c.x_rr * r + c.x_pr * p) + dp * (c.x_pr * r)
    surge = surge + c.heaviness * dg[0]
    sway = du * (c.y_uv * v + c.y_ur * r + c.y_uudr * twice_rudder)
    sway = sway + dv * (c.y_v + c.y_uv * u + 2.0 * c.y_vv * abs(v)) + dw * (c.y_wp * p)
    sway = sway + dp * (c.y_wp * w + c.y_pq * q) + dq * (c.y_qr * r + c.y_pq * p)
    sway = sway + dr * (c.y_r + c.y_ur * u + 2.0 * c.y_rr * abs(r) + c.y_qr * q) + c.heaviness * dg[1]
    heave = du * (c.z_uw * w + c.z_uq * q + c.z_uuds * twice_stern) + dv * (c.z_vp * p)
    heave = heave + dw * (c.z_w + c.z_uw * u + 2.0 * c.z_ww * abs(w))
    heave = heave + dp * (2.0 * c.z_p2 * p + c.z_vp * v + c.z_rp * r) + dr * (c.z_rp * p)
    heave = heave + dq * (c.z_q + c.z_uq * u + 2.0 * c.z_qq * abs(q) + 2.0 * c.z_q2 * q) + c.heaviness * dg[2]
    roll = du * (c.k_up * p + c.k_ur * r) + dw * (c.k_wp * p) + dq * (c.k_qr * r) + dr * (c.k_ur * u + c.k_qr * q)
    roll = roll + dp * (c.k_p + c.k_up * u + 2.0 * c.k_pp * abs(p) + c.k_wp * w) - c.righting * dg[1]
    pitch = du * (c.m_uw * w + c.m_uq * q + c.m_uuds * twice_stern) + dv * (c.m_vr * r + c.m_vp * p)
    pitch = pitch + dw * (c.m_w + c.m_uw * u + 2.0 * c.m_ww * abs(w) + c.m_wq * q)
    pitch = pitch + dp * (c.m_rp * r + c.m_vp * v) + dr * (c.m_vr * v + c.m_rp * p)
    pitch = pitch + dq * (c.m_q + c.m_uq * u + 2.0 * c.m_qq * abs(q) + c.m_wq * w)
    pitch = pitch + c.righting * dg[0] - c.nose_weight * dg[2]
    yaw = du * (c.n_uv * v + c.n_ur * r + c.n_uudr * twice_rudder) + dw * (c.n_wp * p) + dq * (c.n_pq * p)
    yaw = yaw + dv * (c.n_v + c.n_uv * u + 2.0 * c.n_vv * abs(v)) + dp * (c.n_wp * w + c.n_pq * q)
    yaw = yaw + dr * (c.n_r + c.n_ur * u + 2.0 * c.n_rr * abs(r)) + c.nose_weight * dg[1]
    return surge, sway, heave, roll, pitch, yaw


def accelerated(force, c):
    """Accelerations d nu/dt = M^-1 F; for y_G = 0 the matrix falls into (u, w, q) and (v, p, r)."""
    x, y, z, k, m, n = force
    return (
        c.u_of_X * x + c.u_of_Z * z + c.u_of_M * m,
        c.v_of_Y * y + c.v_of_K * k + c.v_of_N * n,
        c.w_of_X * x + c.w_of_Z * z + c.w_of_M * m,
        c.p_of_Y * y + c.p_of_K * k + c.p_of_N * n,
        c.q_of_X * x + c.q_of_Z * z + c.q_of_M * m,
        c.r_of_Y * y + c.r_of_K * k + c.r_of_N * n,
    )


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


GRAVITY = 9.81  # [m/s^2]
CROSS_FLOW_DRAG = 1.1  # c_dc, of a cylinder (Prestero)
FIN_DRAG = 0.56  # c_df, of a fin across the flow (Prestero)
ASPECT_RATIO = 2.21  # of a fin and its image in the hull (Prestero)
BODY_LIFT = 0.003  # a degree, by length over diameter (Hoerner, for slender bodies)
CENTRE_OF_LIFT = 0.65  # of the length, from the nose (Hoerner)
ROLL_ADDED_INERTIA = 0.3  # of the rigid body's, assumed as in the Marine Systems Simulator (r44)


class Sizes(NamedTuple):
    """Main sizes of a slender vehicle with four equal tail fins."""

    mass: float  # [kg]
    length: float  # [m]
    diameter: float  # [m]
    density: float  # of the water [kg/m^3]
    gravity_below: float  # z_G: how far the centre of gravity lies below that of buoyancy [m]
    axial_drag: float | None  # c_d, on the frontal area; None for Prestero's formula
    fin_area: float  # of one fin [m^2]
    fin_place: float  # x of the fins, negative [m]
    fin_arm: float  # of a fin's middle from the axis [m]
    fins: float = 2.0  # fins that lift together


def lamb_factors(a: float, b: float) -> tuple[float, float, float]:
    """Added mass along and across, and added inertia, over those of the displaced water, of a prolate spheroid.

        e^2 = 1 - (b/a)^2,  l = ln((1+e)/(1-e)),  alpha = 2(1-e^2)/e^3 (l/2 - e),  beta = 1/e^2 - (1-e^2) l/(2e^3)
        k_1 = alpha/(2 - alpha),  k_2 = beta/(2 - beta),
        k' = e^4 (beta - alpha)/((2 - e^2)(2e^2 - (2 - e^2)(beta - alpha)))

    Args:
        a: semi-axis along [m], the longer one.
        b: semi-axes across [m].

    Source: Lamb (1932), Hydrodynamics, sections 114 and 115.
    """
    e2 = 1.0 - (b / a) ** 2
    e = math.sqrt(e2)
    log = math.log((1.0 + e) / (1.0 - e))
    alpha = 2.0 * (1.0 - e2) / e**3 * (0.5 * log - e)
    beta = 1.0 / e2 - (1.0 - e2) / (2.0 * e**3) * log
    turning = e2**2 * (beta - alpha) / ((2.0 - e2) * (2.0 * e2 - (2.0 - e2) * (beta - alpha)))
    return alpha / (2.0 - alpha), beta / (2.0 - beta), turning


def axial_drag(length: float, diameter: float) -> float:
    """Prestero's formula of c_d on the frontal area, friction with the hull's form in it; 0.10 for REMUS."""
    slenderness = length / diameter
    area = math.pi * diameter**2 / 4
    form = 1.0 + 60.0 / slenderness**3 + 0.0025 * slenderness
    return 3.397e-3 * math.pi * length * diameter / area * form


def recipe(sizes: Sizes) -> VehicleParameters:
    """All parameters of a vehicle from its main sizes, neutrally buoyant, with its weight amidships."""
    m, length, d, rho = sizes.mass, sizes.length, sizes.diameter, sizes.density
    a, b, x, pressure = length / 2, d / 2, sizes.fin_place, rho / 2
    k_1, k_2, k_turn = lamb_factors(a, b)
    ix, iy = 0.4 * m * b**2, 0.2 * m * (a**2 + b**2)
    xud, yvd, kpd, mqd = -k_1 * m, -k_2 * m, -ROLL_ADDED_INERTIA * ix, -k_turn * iy
    frontal = math.pi * b**2
    c_d = axial_drag(length, d) if sizes.axial_drag is None else sizes.axial_drag
    # Strips of width 2R dx across the flow: the integrals of 2R dx and of 2R |x|^3 dx over the spheroid.
    side, third_moment = math.pi * a * b, 8 / 15 * a**4 * b
    fin_drag = 2 * pressure * sizes.fin_area * FIN_DRAG
    cross = -pressure * CROSS_FLOW_DRAG * side - fin_drag
    turning = -pressure * CROSS_FLOW_DRAG * third_moment - abs(x) ** 3 * fin_drag
    lift = pressure * d**2 * BODY_LIFT * (length / d) * 180 / math.pi
    x_lift = (0.5 - CENTRE_OF_LIFT) * length
    lift_slope = 1 / (1 / (1.8 * math.pi) + 1 / (math.pi * ASPECT_RATIO))
    f = sizes.fins * pressure * lift_slope * sizes.fin_area  # lift of the fins over u^2 times their angle
    munk = xud - yvd
    return checked(
        VehicleParameters(
            m=m, W=m * GRAVITY, B=m * GRAVITY, xG=0.0, yG=0.0, zG=sizes.gravity_below, Ix=ix, Iy=iy, Iz=iy,
            Xud=xud, Yvd=yvd, Yrd=0.0, Zwd=yvd, Zqd=0.0, Kpd=kpd, Mwd=0.0, Mqd=mqd, Nvd=0.0, Nrd=mqd,
            Xuu=-pressure * c_d * frontal, Xwq=yvd, Xqq=0.0, Xvr=-yvd, Xrr=0.0,
            Yvv=cross, Yrr=-x * abs(x) * fin_drag, Yuv=-lift - f, Yur=xud - f * x, Ywp=-yvd, Ypq=0.0, Yuudr=f,
            Zww=cross, Zqq=x * abs(x) * fin_drag, Zuw=-lift - f, Zuq=-xud + f * x, Zvp=yvd, Zrp=0.0, Zuuds=-f,
            Kpp=-fin_drag * sizes.fin_arm**3, Kup=-2 * f * sizes.fin_arm**2,
            Mww=-x * fin_drag, Mqq=turning, Muw=munk + x_lift * lift + x * f, Muq=-f * x**2, Mvp=0.0,
            Mrp=kpd - mqd, Muuds=x * f,
            Nvv=x * fin_drag, Nrr=turning, Nuv=-munk - x_lift * lift - x * f, Nur=-f * x**2, Nwp=0.0,
            Npq=mqd - kpd, Nuudr=x * f,
        )
    )  # fmt: skip


SEGOROGENI_SIZES = Sizes(
    mass=15.0,
    length=0.98,
    diameter=0.188,
    density=1025.0,
    gravity_below=0.02,
    axial_drag=0.20,
    fin_area=0.0053,
    fin_place=-0.42,
    fin_arm=0.087,
)
"""Segorogeni ITS. Ngatini and Nurhadi (2019), table I, print mass, length, and a beam that is taken as diameter.

Not printed, and assumed here: sea water, neutral buoyancy; z_G = 0.02 m (REMUS has 0.0196); c_d = 0.20, which
Sgarioto and others use for REMUS; fins of LAUV's 0.0064 m^2 scaled by (0.98/1.08)^2, at 0.86 of the half length
from the middle, between LAUV's 0.74 and REMUS's 0.96; the fin's arm is the hull's radius there and half of its
span. The stability margin hinges on the fins: it vanishes at 0.0037 m^2. A spheroid of these sizes displaces
18.6 kg, the vehicle has 15 kg: added masses are those of 15 kg.
"""

SEGOROGENI = recipe(SEGOROGENI_SIZES)
"""Segorogeni by the recipe, with the damping of roll by its fins."""

SEGOROGENI_PAPERS = SEGOROGENI._replace(Kup=0.0)
"""The same with the papers' terms alone: at 1 m/s it rolls with a period of 0.94 s that takes 33 s to decay."""

REMUS_SIZES = Sizes(
    mass=30.48,
    length=1.33,
    diameter=0.191,
    density=1030.0,
    gravity_below=0.0196,
    axial_drag=None,
    fin_area=0.00665,
    fin_place=-0.638,
    fin_arm=0.131,
)
"""REMUS 100 as Prestero (2001) has it; the axial drag by his formula."""

REMUS100 = recipe(REMUS_SIZES)
"""REMUS 100 by the recipe: the lift of both fins of a pair makes it stable on a straight course."""

REMUS100_PRESTERO = VehicleParameters(
    m=30.48, W=299.0, B=299.0, xG=0.0, yG=0.0, zG=0.0196, Ix=0.177, Iy=3.45, Iz=3.45,
    Xud=-0.93, Yvd=-35.5, Yrd=1.93, Zwd=-35.5, Zqd=-1.93, Kpd=-0.0704, Mwd=-1.93, Mqd=-4.88, Nvd=1.93, Nrd=-4.88,
    Xuu=-1.62, Xwq=-35.5, Xqq=-1.93, Xvr=35.5, Xrr=-1.93,
    Yvv=-131.0, Yrr=0.632, Yuv=-28.6, Yur=5.22, Ywp=35.5, Ypq=1.93, Yuudr=9.64,
    Zww=-131.0, Zqq=-0.632, Zuw=-28.6, Zuq=-5.22, Zvp=-35.5, Zrp=1.93, Zuuds=-9.64,
    Kpp=-0.13, Kup=0.0,
    Mww=3.18, Mqq=-9.4, Muw=24.0, Muq=-2.0, Mvp=-1.93, Mrp=4.86, Muuds=-6.15,
    Nvv=-3.18, Nrr=-9.4, Nuv=-24.0, Nur=-2.0, Nwp=-1.93, Npq=-4.86, Nuudr=-6.15,
)  # fmt: skip
"""REMUS 100 as printed by Prestero (2001); unstable on a straight course, so data to compare with.

Public files disagree: Yvv and Zww are -131 or -1310, Mqq -9.4 or -188, Nrr -9.4 or -94. Strips give -117 and
-6.6, so the first of each pair is taken.
"""

_LAUV_FINS = 2 * 0.5 * 1028.0 * 0.0064 * 3.0  # lift of a pair over u^2 times its angle: density, area, slope

LAUV = VehicleParameters(
    m=18.0, W=18.0 * GRAVITY, B=1028.0 * 0.017551374956865266 * GRAVITY, xG=0.0, yG=0.0, zG=0.01,
    Ix=0.5 * 18.0 * 0.075**2, Iy=18.0 / 12 * (3 * 0.075**2 + 1.08**2), Iz=18.0 / 12 * (3 * 0.075**2 + 1.08**2),
    Xud=-1.0, Yvd=-16.0, Yrd=0.0, Zwd=-16.0, Zqd=0.0, Kpd=-0.005, Mwd=0.0, Mqd=-1.3, Nvd=0.0, Nrd=-1.3,
    Xuu=-2.4, Xwq=-16.0, Xqq=0.0, Xvr=16.0, Xrr=0.0,
    Yvv=-80.0, Yrr=0.3, Yuv=-_LAUV_FINS, Yur=-1.0 + 0.4 * _LAUV_FINS, Ywp=16.0, Ypq=0.0, Yuudr=_LAUV_FINS,
    Zww=-80.0, Zqq=-0.3, Zuw=-_LAUV_FINS, Zuq=1.0 - 0.4 * _LAUV_FINS, Zvp=-16.0, Zrp=0.0, Zuuds=-_LAUV_FINS,
    Kpp=-0.0006, Kup=-2 * _LAUV_FINS * 0.04**2,
    Mww=1.5, Mqq=-9.1, Muw=15.0 - 0.4 * _LAUV_FINS, Muq=-(0.4**2) * _LAUV_FINS, Mvp=0.0, Mrp=1.295,
    Muuds=-0.4 * _LAUV_FINS,
    Nvv=-1.5, Nrr=-9.1, Nuv=-15.0 + 0.4 * _LAUV_FINS, Nur=-(0.4**2) * _LAUV_FINS, Nwp=0.0, Npq=-1.295,
    Nuudr=-0.4 * _LAUV_FINS,
    Xu=-2.4, Yv=-23.0, Yr=11.5, Zw=-23.0, Zq=-11.5, Kp=-0.3, Mw=3.1, Mq=-9.7, Nv=-3.1, Nr=-9.7,
)  # fmt: skip
"""LAUV as the Gazebo simulation lauv_gazebo (Apache-2.0) has it, its linear damping included.

Mass, inertia, volume, added mass and damping are that file's. The products of velocities that come with the added
mass (Munk's moment among them) follow from it; the fins lift with a slope of 3 at x = -0.4 m, 0.04 m off the axis.
The hull's lift is not apart there: it is in the linear damping. gym-auv has the same damping, and an added mass
from Lamb's factors with e = 1 - (b/a)^2, of which the root is forgotten. Coefficients hold about the centre of
gravity there, and about the centre of buoyancy 1 cm above it here.
"""

PRESETS: dict[str, VehicleParameters] = {
    "segorogeni": SEGOROGENI,
    "segorogeni_papers": SEGOROGENI_PAPERS,
    "remus100": REMUS100,
    "remus100_prestero": REMUS100_PRESTERO,
    "lauv": LAUV,
}


def preset_parameters(preset: str | Mapping | VehicleParameters) -> VehicleParameters:
    """Parameters from a preset's name, a mapping of all fields, or parameters; ValueError otherwise."""
    if isinstance(preset, VehicleParameters):
        return checked(preset)
    if isinstance(preset, Mapping):
        return parameters_of(preset)
    return PRESETS[one_of("preset", preset, tuple(PRESETS))]
