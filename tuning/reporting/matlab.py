"""A tuned filter as a MATLAB function: its model, Q, R and, where it is an extended Kalman filter, its step.

The code runs in MATLAB and in GNU Octave without a toolbox. The functions f and h take columns, as
`extendedKalmanFilter` and `unscentedKalmanFilter` of MATLAB's toolboxes want them.
"""

from __future__ import annotations

import re

import numpy as np

from thruster_env.model.affine import AffineModel
from thruster_env.model.state_space import StateSpaceModel
from tuning.reporting.traced import traced
from tuning.search.space import Choice

STEPPED = ("kf", "ekf")  # of which there is a step
LONGEST = 1500  # lines of f or h
HEAD = """function [x, P, e, S] = {name}(x, P, z, u)
%{shout}  The {filter} filter tuned on {problem}, model, Q and R included.
%   m = {name}() gives the model: m.f(x, u), m.h(x), m.Q, m.R, m.x0, m.P0{more}.
%   Covariances are per step and do not scale with dt.
%   States: {states}
%   Inputs: {inputs}
%   Measurements: {measurements}
"""
STEP = """%   [x, P, e, S] = {name}(x, P, z, u) updates with what was measured (NaN: missing), z, which gives the
%   estimate that x and P hold after it, the innovation e and its covariance S, and where u is given it then
%   predicts over one step. Begin with x = m.x0, P = m.P0.
%
%   m = {name}(); x = m.x0; P = m.P0;
%   for k = 1:size(z, 2)
%       [x, P, e, S] = {name}(x, P, z(:, k));
%       estimate(:, k) = x;
%       if k < size(z, 2), [x, P] = {name}(x, P, [], u(:, k)); end
%   end
"""
TOOLBOX = """%   With MATLAB's toolboxes, here as an unscented Kalman filter:
%   o = unscentedKalmanFilter(m.f, m.h, m.x0, 'StateCovariance', m.P0, ...
%       'ProcessNoise', m.Q, 'MeasurementNoise', m.R);
%   for k = 1:size(z, 2), estimate(:, k) = correct(o, z(:, k)); predict(o, u(:, k)); end
"""
UPDATE = """
e = []; S = [];
if ~isempty(z)
    there = ~isnan(z(:));
    e = z(:) - m.h(x);{wrap}
    H = slopes(m.h, x);
    S = H * P * H' + m.R;
    S = (S + S') / 2;
    if any(there)
        K = P * H(there, :)' / S(there, there);
        x = x + K * e(there);
        I = eye(numel(x)) - K * H(there, :);
        P = I * P * I' + K * m.R(there, there) * K';
    end
end
if nargin > 3
    F = slopes(@(y) m.f(y, u), x);
    x = m.f(x, u);
    P = F * P * F' + m.Q;
    P = (P + P') / 2;
end
end

function J = slopes(g, x)  % central differences
J = zeros(numel(g(x)), numel(x));
for j = 1:numel(x)
    d = zeros(numel(x), 1);
    d(j) = 1e-6 * max(1, abs(x(j)));
    J(:, j) = (g(x + d) - g(x - d)) / (2 * d(j));
end
end
"""


def matlab_function(choice: Choice, model: StateSpaceModel, problem: str, dt: float | None) -> str:
    """The text of NAME.m, whose function gives a tuned filter's model and, of a Kalman filter, its step.

    Args:
        choice: the tuned filter.
        model: what it assumes.
        problem: what it was tuned on.
        dt: sample time [s], if it has one.
    """
    name = function_name(choice.name, problem)
    try:
        (pieces, fields), why = _functions(model), ""
    except ValueError as error:
        pieces, fields, why = "", [], str(error)
    steps = choice.name in STEPPED and pieces and (choice.name == "ekf" or isinstance(model, AffineModel))
    head = HEAD + (STEP if steps else TOOLBOX if pieces else "")
    text = head.format(
        name=name,
        shout=name.upper(),
        filter=choice.name,
        problem=problem,
        more=", m.A, m.B, m.C" if isinstance(model, AffineModel) else "",
        states=_listed(model.states),
        inputs=_listed(model.input_quantities),
        measurements=_listed(model.measurements),
    )
    if not pieces:
        text = text.replace(": m.f(x, u), m.h(x), ", ": ")
        text += (
            f"%   f and h are code that cannot be written out: m.f and m.h are yours to add.\n%   Why: {why}.\n"
        )
    lines = [f"m.dt = {dt:.17g};"] if dt else []
    lines += [f"m.Q = {_matrix(model.process_noise_cov)};", f"m.R = {_matrix(model.measurement_noise_cov)};"]
    lines += [f"m.x0 = {_matrix(model.prior_mean[:, None])};", f"m.P0 = {_matrix(model.prior_cov)};", *fields]
    if pieces:
        lines += ["m.f = @transition;", "m.h = @measurement;"]
    text += "\n".join(lines) + "\nif nargin == 0, x = m; return; end\n"
    turns = [j + 1 for j, one in enumerate(model.measurements) if one.angle]
    wrap = f"\n    e({turns}) = mod(e({turns}) + pi, 2 * pi) - pi;  % the short way round" if turns else ""
    return (
        text
        + (
            UPDATE.replace("{wrap}", wrap)
            if steps
            else "error('the step of this filter is not written out');\nend\n"
        )
        + pieces
    )


def function_name(*parts: str) -> str:
    """A name that MATLAB takes for a function, made of some parts."""
    words = re.sub(r"\W+", "_", "_".join(parts)).strip("_")[:50]
    return words if words[:1].isalpha() else f"f_{words}"


def _functions(model: StateSpaceModel) -> tuple[str, list[str]]:
    """Functions f and h, and more fields of the struct; ValueError if they cannot be written out."""
    if isinstance(model, AffineModel):
        a, b, offset, c, shift = model.matrices()
        moved = f"y = {_matrix(a)} * x + {_matrix(offset[:, None])}"
        moved += f" + {_matrix(b)} * u(:);" if model.inputs else ";"
        read = f"z = {_matrix(c)} * x + {_matrix(shift[:, None])};"
        fields = [f"m.A = {_matrix(a)};", f"m.B = {_matrix(b)};", f"m.C = {_matrix(c)};"]
        return (
            f"\nfunction y = transition(x, u)\n{moved}\nend\n\nfunction z = measurement(x)\n{read}\nend\n",
            fields,
        )
    x, u = [f"x({i + 1})" for i in range(model.n)], [f"u({i + 1})" for i in range(model.inputs)]
    f = traced(model.transition, (x, u), model.given_constants)
    h = traced(model.observe, (x,), model.given_constants)
    if max(len(f), len(h)) > LONGEST:
        raise ValueError(f"f and h must have at most {LONGEST} lines, but they have {len(f)} and {len(h)}")
    whole = "\n".join(f"    {line}" for line in (*f[:-1], f"x = {f[-1]};"))
    loop = f"for part = 1:{model.substeps}\n{whole}\nend\ny = x;"
    seen = "\n".join((*h[:-1], f"z = {h[-1]};"))
    return f"\nfunction y = transition(x, u)\n{loop}\nend\n\nfunction z = measurement(x)\n{seen}\nend\n", []


def _matrix(values: np.ndarray) -> str:
    """A matrix as MATLAB writes it."""
    values = np.asarray(values, dtype=float)
    if values.shape == (1, 1):
        return f"{values[0, 0]:.17g}"
    if values.ndim == 2 and values.shape[0] == values.shape[1] and not (values - np.diag(values.diagonal())).any():
        return f"diag([{', '.join(f'{value:.17g}' for value in values.diagonal())}])"
    return f"[{'; '.join(', '.join(f'{value:.17g}' for value in row) for row in values)}]"


def _listed(quantities) -> str:
    return ", ".join(one.label for one in quantities) or "none"
