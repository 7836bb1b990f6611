"""Attitude and path of a vehicle: Euler angles, transformations between body and earth, their tangents.

Roll phi, pitch theta, yaw psi [rad]; the earth's axes are north, east, down, the body's ahead, starboard, down. An
attitude is (cos phi, sin phi, cos theta, sin theta). Euler angles end at theta = +-90 deg, where the rates of phi
and psi are infinite. Source: Fossen (2011), "Handbook of Marine Craft Hydrodynamics and Motion Control", 2.2.
"""

from __future__ import annotations

from thruster_env.core.compiled import inlined
from thruster_env.core.trigonometry import cosine_and_sine


@inlined
def attitude_of(phi, theta):
    """(cos phi, sin phi, cos theta, sin theta)."""
    c_phi, s_phi = cosine_and_sine(phi)
    c_theta, s_theta = cosine_and_sine(theta)
    return c_phi, s_phi, c_theta, s_theta


@inlined
def attitude_tangent(attitude, d_phi, d_theta):
    """Directional derivative of `attitude_of`."""
    c_phi, s_phi, c_theta, s_theta = attitude
    return -s_phi * d_phi, c_phi * d_phi, -s_theta * d_theta, c_theta * d_theta


@inlined
def down(attitude):
    """The direction downwards in the body's axes: (-sin theta, cos theta sin phi, cos theta cos phi)."""
    c_phi, s_phi, c_theta, s_theta = attitude
    return -s_theta, c_theta * s_phi, c_theta * c_phi


@inlined
def down_tangent(attitude, d_attitude):
    """Directional derivative of `down`."""
    c_phi, s_phi, c_theta, s_theta = attitude
    dc_phi, ds_phi, dc_theta, ds_theta = d_attitude
    return -ds_theta, dc_theta * s_phi + c_theta * ds_phi, dc_theta * c_phi + c_theta * dc_phi


@inlined
def angle_rates(attitude, p, q, r):
    """Rates of roll, pitch and yaw [rad/s] of a body that turns with p, q, r [rad/s].

    phi' = p + psi' sin theta,  theta' = q cos phi - r sin phi,  psi' = (q sin phi + r cos phi)/cos theta
    """
    c_phi, s_phi, c_theta, s_theta = attitude
    turning = (q * s_phi + r * c_phi) / c_theta
    return p + turning * s_theta, q * c_phi - r * s_phi, turning


@inlined
def angle_rates_tangent(attitude, d_attitude, q, r, dp, dq, dr):
    """Directional derivative of `angle_rates`."""
    c_phi, s_phi, c_theta, s_theta = attitude
    dc_phi, ds_phi, dc_theta, ds_theta = d_attitude
    per_cosine = 1.0 / c_theta
    turning = (q * s_phi + r * c_phi) * per_cosine
    d_turning = dq * s_phi + q * ds_phi + dr * c_phi + r * dc_phi - turning * dc_theta
    d_turning = d_turning * per_cosine
    d_rolling = dp + d_turning * s_theta + turning * ds_theta
    return d_rolling, dq * c_phi + q * dc_phi - dr * s_phi - r * ds_phi, d_turning


@inlined
def _levelled(attitude, u, v, w):
    """A vector in axes that turn with the body's heading only: ahead, to starboard and down."""
    c_phi, s_phi, c_theta, s_theta = attitude
    below = v * s_phi + w * c_phi
    return u * c_theta + below * s_theta, v * c_phi - w * s_phi, below * c_theta - u * s_theta


@inlined
def in_earth_axes(attitude, psi, u, v, w):
    """Components to the north, to the east and down of a vector (u, v, w) in the body's axes."""
    c_psi, s_psi = cosine_and_sine(psi)
    ahead, aside, below = _levelled(attitude, u, v, w)
    return ahead * c_psi - aside * s_psi, ahead * s_psi + aside * c_psi, below


@inlined
def in_earth_axes_tangent(attitude, d_attitude, psi, d_psi, velocity, d_velocity):
    """Directional derivative of `in_earth_axes`; the vector and its change are (u, v, w)."""
    u, v, w = velocity
    du, dv, dw = d_velocity
    c_phi, s_phi, c_theta, s_theta = attitude
    dc_phi, ds_phi, dc_theta, ds_theta = d_attitude
    c_psi, s_psi = cosine_and_sine(psi)
    ahead, aside, _ = _levelled(attitude, u, v, w)
    below, d_below = v * s_phi + w * c_phi, dv * s_phi + v * ds_phi + dw * c_phi + w * dc_phi
    d_ahead = du * c_theta + u * dc_theta + d_below * s_theta + below * ds_theta - aside * d_psi
    d_aside = dv * c_phi + v * dc_phi - dw * s_phi - w * ds_phi + ahead * d_psi
    return (
        d_ahead * c_psi - d_aside * s_psi,
        d_ahead * s_psi + d_aside * c_psi,
        d_below * c_theta + below * dc_theta - du * s_theta - u * ds_theta,
    )


@inlined
def in_body_axes(attitude, psi, north, east, below):
    """Components ahead, to starboard and down in the body's axes of a vector in the earth's."""
    c_phi, s_phi, c_theta, s_theta = attitude
    c_psi, s_psi = cosine_and_sine(psi)
    ahead, aside = north * c_psi + east * s_psi, east * c_psi - north * s_psi
    across = ahead * s_theta + below * c_theta
    return ahead * c_theta - below * s_theta, aside * c_phi + across * s_phi, across * c_phi - aside * s_phi


@inlined
def in_body_axes_tangent(attitude, d_attitude, psi, d_psi, vector, d_vector):
    """Directional derivative of `in_body_axes`; the vector and its change are (north, east, down)."""
    (north, east, below), (d_north, d_east, d_below) = vector, d_vector
    c_phi, s_phi, c_theta, s_theta = attitude
    dc_phi, ds_phi, dc_theta, ds_theta = d_attitude
    c_psi, s_psi = cosine_and_sine(psi)
    ahead, aside = north * c_psi + east * s_psi, east * c_psi - north * s_psi
    d_ahead = d_north * c_psi + d_east * s_psi + aside * d_psi
    d_aside = d_east * c_psi - d_north * s_psi - ahead * d_psi
    across = ahead * s_theta + below * c_theta
    d_across = d_ahead * s_theta + ahead * ds_theta + d_below * c_theta + below * dc_theta
    return (
        d_ahead * c_theta + ahead * dc_theta - d_below * s_theta - below * ds_theta,
        d_aside * c_phi + aside * dc_phi + d_across * s_phi + across * ds_phi,
        d_across * c_phi + across * dc_phi - d_aside * s_phi - aside * ds_phi,
    )


@inlined
def planar_kinematics(nu, psi):
    """The papers' rates of x, y, z [m/s] and psi [rad/s], which turn by yaw alone.

        x' = u cos psi - v sin psi,  y' = u sin psi + v cos psi,  z' = w,  psi' = r

    True for phi = theta = 0 only: a vehicle that dives by pitching stays at its depth here. Source: Ngatini,
    Nurhadi (2019), equations 1 to 4.
    """
    u, v, w, _, _, r = nu
    c_psi, s_psi = cosine_and_sine(psi)
    return u * c_psi - v * s_psi, u * s_psi + v * c_psi, w, r
