"""Forces and moments on an underwater vehicle, once, and the accelerations that they cause.

    M d nu/dt = F(nu, phi, theta, u)

Velocities nu = (u, v, w, p, q, r) are those through the water in the body's axes: ahead, to starboard and down
[m/s], in roll, pitch and yaw [rad/s]. Input u = (X_prop, K_prop, delta_s, delta_r): the propeller's thrust [N] and
torque [N m], the angles of stern plane and rudder [rad]. delta_s > 0 pitches the nose down, delta_r > 0 turns the
vehicle to port.

F is Prestero's (2001), term by term, as Ngatini and Nurhadi (2019) print it; damping of roll by the fins and
linear damping are added, both zero in the papers. The lift of body and fins goes with u v and u^2: the equations
hold for a vehicle that goes ahead. Only operators and abs occur, so the same source runs on floats, NumPy arrays
and torch tensors and compiles with numba.
"""

from __future__ import annotations

from typing import NamedTuple

from thruster_env.core.compiled import inlined


class Constants(NamedTuple):
    """The constants of the equations; `parameters.derive_constants` computes them from a vehicle.

    `y_ur` is the factor of u r in the sway force, the rigid body's m u r included; `u_of_X` is an entry of the
    inverse mass matrix, the surge acceleration by a unit of surge force.
    """

    heaviness: float  # W - B [N]
    righting: float  # z_G W [N m]
    nose_weight: float  # x_G W [N m]
    x_u: float
    x_uu: float
    x_wq: float
    x_qq: float
    x_vr: float
    x_rr: float
    x_pr: float
    y_v: float
    y_vv: float
    y_uv: float
    y_r: float
    y_rr: float
    y_ur: float
    y_qr: float
    y_wp: float
    y_pq: float
    y_uudr: float
    z_w: float
    z_ww: float
    z_uw: float
    z_q: float
    z_qq: float
    z_uq: float
    z_q2: float  # of q^2, where z_qq is that of q |q|
    z_p2: float
    z_vp: float
    z_rp: float
    z_uuds: float
    k_p: float
    k_pp: float
    k_up: float
    k_wp: float
    k_ur: float
    k_qr: float
    m_w: float
    m_ww: float
    m_uw: float
    m_q: float
    m_qq: float
    m_uq: float
    m_wq: float
    m_vr: float
    m_vp: float
    m_rp: float
    m_uuds: float
    n_v: float
    n_vv: float
    n_uv: float
    n_r: float
    n_rr: float
    n_ur: float
    n_wp: float
    n_pq: float
    n_uudr: float
    u_of_X: float
    u_of_Z: float
    u_of_M: float
    v_of_Y: float
    v_of_K: float
    v_of_N: float
    w_of_X: float
    w_of_Z: float
    w_of_M: float
    p_of_Y: float
    p_of_K: float
    p_of_N: float
    q_of_X: float
    q_of_Z: float
    q_of_M: float
    r_of_Y: float
    r_of_K: float
    r_of_N: float
    propeller_torque: float  # K_prop over X_prop [m], where that is no input
    substep: float  # time step of one integration step [s]


@inlined
def forces(nu, g, inputs, c):
    """Forces X, Y, Z [N] and moments K, M, N [N m] on a vehicle of velocities nu, without those of acceleration.

    g is the direction downwards in the body's axes (`kinematics.down`), inputs = (X_prop, K_prop, delta_s,
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


@inlined
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


@inlined
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
