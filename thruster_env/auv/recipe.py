"""The parameters of a slender vehicle from its main sizes: a spheroid, strips and four tail fins.

Hull and added mass are those of a prolate spheroid (Lamb); cross-flow drag by strips, the lift of the body by
Hoerner's formula and the lift of the fins follow Prestero (2001), chapter 4, and so do the products of velocities
that come with the added mass.

Two things differ from prints. The moment of the body's lift reduces the Munk moment, as in the values that
Prestero prints (Muw 24.0 = 34.6 - 4.4 - 6.2): a public file of his formulas has the other sign. And the fins'
factors hold for a pair of fins; the values printed for REMUS are half of that (`fins=1`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from thruster_env.auv.parameters import VehicleParameters, checked

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
            m=m,
            W=m * GRAVITY,
            B=m * GRAVITY,
            xG=0.0,
            yG=0.0,
            zG=sizes.gravity_below,
            Ix=ix,
            Iy=iy,
            Iz=iy,
            Xud=xud,
            Yvd=yvd,
            Yrd=0.0,
            Zwd=yvd,
            Zqd=0.0,
            Kpd=kpd,
            Mwd=0.0,
            Mqd=mqd,
            Nvd=0.0,
            Nrd=mqd,
            Xuu=-pressure * c_d * frontal,
            Xwq=yvd,
            Xqq=0.0,
            Xvr=-yvd,
            Xrr=0.0,
            Yvv=cross,
            Yrr=-x * abs(x) * fin_drag,
            Yuv=-lift - f,
            Yur=xud - f * x,
            Ywp=-yvd,
            Ypq=0.0,
            Yuudr=f,
            Zww=cross,
            Zqq=x * abs(x) * fin_drag,
            Zuw=-lift - f,
            Zuq=-xud + f * x,
            Zvp=yvd,
            Zrp=0.0,
            Zuuds=-f,
            Kpp=-fin_drag * sizes.fin_arm**3,
            Kup=-2 * f * sizes.fin_arm**2,
            Mww=-x * fin_drag,
            Mqq=turning,
            Muw=munk + x_lift * lift + x * f,
            Muq=-f * x**2,
            Mvp=0.0,
            Mrp=kpd - mqd,
            Muuds=x * f,
            Nvv=x * fin_drag,
            Nrr=turning,
            Nuv=-munk - x_lift * lift - x * f,
            Nur=-f * x**2,
            Nwp=0.0,
            Npq=mqd - kpd,
            Nuudr=x * f,
        )
    )
