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

from collections import namedtuple

from thruster_env.core.compiled import inlined

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


@inlined
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
