"""A Kalman filter as lines to paste: ours, FilterPy, pykalman, MATLAB, and a loop for a controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from filters.named import NamedMaker
from thruster_env.core.checks import one_of
from thruster_env.model.affine import AffineModel

ARDUINO = "arduino"  # the only one of constant gain
BURST = 10  # far numbers in a row that are outliers; more are a jump


class UnequalSteps(NamedTuple):
    """What gives F and Q of a step of any length."""

    maker: NamedMaker  # of the model in continuous time
    dt: float  # usual step [s]
    slope: np.ndarray  # A, (n, n), of all axes
    densities: np.ndarray  # D, (n, n)
    shortest: float  # step of the record [s]
    longest: float


def lines_of(
    language: str,
    model: AffineModel,
    gain: np.ndarray,
    dt: float,
    gate: float | None = None,
    turns: Sequence[float] = (),
    unequal: UnequalSteps | None = None,
    has_gaps: bool = False,
) -> str:
    """The filter of a model without inputs as lines of a language, below a comment with sample time and units.

    Lines for steps of any length compute F and Q of each, those of a constant gain cannot.

    Args:
        language: a key of `LANGUAGES`.
        model: F, H, Q, R, the first state and its covariance; the measurement's offset is subtracted from z.
        gain: K (n, m), the steady-state gain.
        dt: sample time [s].
        gate: standard deviations of S beyond which measurements are left out; all are taken if None.
        turns: a whole turn of each measurement that wraps, 0 for others; none do if empty.
        unequal: for steps of any length; None if all are of dt.
        has_gaps: whether the record has steps of dt without a number.

    Raises:
        ValueError: for another language.
    """
    lines = LANGUAGES[one_of("a language", language, tuple(LANGUAGES))](model, gain, gate, unequal)
    step = f"a step is {dt:.12g} s"
    if unequal is not None:
        step = step if language == ARDUINO else "a step may have any length [s]"
        step = f"{step}; those of the record have {unequal.shortest:.4g} to {unequal.longest:.4g} s"
    elif has_gaps:
        step = f"{step}; one without a measurement counts, with z = NaN"
    comment = COMMENTS.get(language, "#")
    units = [
        f"{word}: {', '.join(f'{quantity.symbol} [{quantity.unit or 1}]' for quantity in quantities)}"
        for word, quantities in (("measured", model.measurements), ("state", model.states))
    ]
    unwrapped = [
        f"{quantity.symbol} wraps: before the filter z = z + {turn:.12g} round((z_before - z)/{turn:.12g}), "
        "where z_before is the last such z"
        for quantity, turn in zip(model.measurements, turns, strict=False)
        if turn
    ]
    heads = [f"{comment} {line}" for line in (step, *units, *unwrapped)]
    return "\n".join([*heads, lines])


def _python(model: AffineModel, gain: np.ndarray, gate: float | None, unequal: UnequalSteps | None = None) -> str:
    if unequal is not None:
        return _python_of_any_step(unequal, gate)
    a, _, _, c, d = model.matrices()
    session = f"""
session = filter_.session(gate={gate}, most={BURST})  # it leaves outliers out, at most {BURST} in a row
session.start()
# session.update(z[0]), then session.step([], z) for each further one: session.mean, session.cov"""
    return f"""import numpy as np
import filters

filter_ = filters.make_filter("kf", filters.affine_model(
    a={_rows(a)},
    b=np.zeros(({model.n}, 0)),
    c={_rows(c)},
    process_noise_cov={_rows(model.process_noise_cov)},
    measurement_noise_cov={_rows(model.measurement_noise_cov)},
    prior_mean={_numbers(model.prior_mean)},
    prior_cov={_rows(model.prior_cov)},
    measurement_offset={_numbers(d)},
))""" + ("" if gate is None else session)


def _python_of_any_step(unequal: UnequalSteps, gate: float | None) -> str:
    maker, dt = unequal.maker, _number(unequal.dt)
    quantities = ", ".join(f"Quantity{tuple(quantity[:3])}" for quantity in maker.quantities)
    values = ", ".join(f"{name!r}: {_number(value)}" for name, value in maker.values.items())
    means = {"mean": maker.mean, "first": maker.first}
    advice = (
        "" if gate is None else f"# outliers, beyond {gate} standard deviations of their prediction, are NaN\n"
    )
    return (
        f"""import numpy as np
import filters
from filters.named import NamedMaker
from thruster_env.model.quantities import Quantity

plant = NamedMaker(
    {maker.name!r},
    quantities=[{quantities}],
    values={{{values}}},
"""
        + "".join(
            f"    {name}=[{', '.join(map(_number, numbers))}],\n"
            for name, numbers in means.items()
            if numbers is not None
        )
        + f"""    spread={_number(maker.spread)},
).continuous(dt={dt})
filter_ = filters.make_filter("ekf", plant.at({dt}))
{advice}# z at times t [s]: filters.run(filter_, z, dt=np.diff(t), noise=plant.noise)"""
    )


def _step_of_python(unequal: UnequalSteps) -> str:
    """A function of a step's length that gives F and Q, by halvings so that no exponential is large."""
    n = len(unequal.slope)
    return f"""from scipy.linalg import expm

A = np.array({_rows(unequal.slope)})
D = np.array({_rows(unequal.densities)})


def step(dt):  # F and Q of a step of dt [s]
    halvings = int(max(np.ceil(np.log2(1e-9 + np.abs(A).sum() * dt)), 0))
    e = expm(np.block([[-A, D], [0 * A, A.T]]) * dt / 2**halvings)
    F = e[{n}:, {n}:].T
    Q = F @ e[:{n}, {n}:]
    for _ in range(halvings):
        F, Q = F @ F, Q + F @ Q @ F.T
    return F, Q


"""


def _filterpy(
    model: AffineModel, gain: np.ndarray, gate: float | None, unequal: UnequalSteps | None = None
) -> str:
    a, _, _, c, d = model.matrices()
    begin, far, or_far = "", "", ""
    if gate is not None:
        deviations = "np.sqrt(np.diag(kf.H @ kf.P @ kf.H.T + kf.R))"
        begin = f"in_a_row = np.zeros({model.m})  # outliers; after {BURST} the level is another one\n"
        far = f"""far = abs(np.reshape(z{_less(d)}, (-1, 1)) - kf.H @ kf.x)[:, 0] > {gate} * {deviations}
in_a_row = np.where(np.isnan(z), in_a_row, np.where(far, in_a_row + 1, 0))
"""
        or_far = f" or (far & (in_a_row <= {BURST})).any()"
    head, after = "\n", "then for each further one"
    noise, before = f"kf.F = np.array({_rows(a)})\nkf.Q = np.array({_rows(model.process_noise_cov)})\n", ""
    if unequal is not None:
        head, after, noise = _step_of_python(unequal), f"{after}, dt [s] later", ""
        before = "kf.F, kf.Q = step(dt)\n"
    return f"""import numpy as np
from filterpy.kalman import KalmanFilter
{head}kf = KalmanFilter(dim_x={model.n}, dim_z={model.m})
{noise}kf.H = np.array({_rows(c)})
kf.R = np.array({_rows(model.measurement_noise_cov)})
kf.x = np.array([{_numbers(model.prior_mean)}]).T
kf.P = np.array({_rows(model.prior_cov)})
{begin}# the first measurement updates the state at once: kf.update(z[0]{_less(d)}), {after}
{before}kf.predict()
{far}kf.update(None if np.isnan(z).any(){or_far} else z{_less(d)})"""


def _pykalman(
    model: AffineModel, gain: np.ndarray, gate: float | None, unequal: UnequalSteps | None = None
) -> str:
    a, _, _, c, d = model.matrices()
    advice = "" if gate is None else "# pykalman has no gate: set outliers of z to NaN first\n"
    head, steps, f, q = "\n", "", _rows(a), _rows(model.process_noise_cov)
    if unequal is not None:
        head, steps = _step_of_python(unequal), "steps = [step(dt) for dt in np.diff(t)]  # t: times of z [s]\n"
        f, q = "np.array([F for F, _ in steps])", "np.array([Q for _, Q in steps])"
    return f"""import numpy as np
from pykalman import KalmanFilter
{head}{advice}{steps}kf = KalmanFilter(
    transition_matrices={f},
    observation_matrices={_rows(c)},
    transition_covariance={q},
    observation_covariance={_rows(model.measurement_noise_cov)},
    observation_offsets={_numbers(d)},
    initial_state_mean={_numbers(model.prior_mean)},
    initial_state_covariance={_rows(model.prior_cov)},
)
means, covs = kf.filter(np.ma.masked_invalid(z))"""


def _matlab(model: AffineModel, gain: np.ndarray, gate: float | None, unequal: UnequalSteps | None = None) -> str:
    a, _, _, c, d = model.matrices()
    z, offset = "z(:, k)" if model.m > 1 else "z(k)", _matlab_rows(d[:, None]) if model.m > 1 else _number(d[0])
    less = f" - {offset}" if d.any() else ""
    begin, far, near = "", "", ""
    if gate is not None:
        begin = f"in_a_row = zeros({model.m}, 1);  % outliers in a row; after {BURST} the level is another one\n"
        far = f"""    far = abs(v) > {gate}*sqrt(diag(S));
    in_a_row = far.*(in_a_row + 1) + isnan(v).*in_a_row;
"""
        near = f" && ~any(far & in_a_row <= {BURST})"
    noise, step = f"F = {_matlab_rows(a)};\nQ = {_matlab_rows(model.process_noise_cov)};\n", ""
    if unequal is not None:
        n = model.n
        noise = f"A = {_matlab_rows(unequal.slope)};\nD = {_matlab_rows(unequal.densities)};\n"
        step = f"""        dt = t(k) - t(k - 1);  % t: times of z [s]
        halvings = max(ceil(log2(1e-9 + sum(abs(A(:)))*dt)), 0);
        E = expm([-A, D; 0*A, A']*dt/2^halvings);
        F = E({n + 1}:end, {n + 1}:end)';
        Q = F*E(1:{n}, {n + 1}:end);
        for i = 1:halvings
            Q = Q + F*Q*F';
            F = F*F;
        end
"""
    return f"""{noise}H = {_matlab_rows(c)};
R = {_matlab_rows(model.measurement_noise_cov)};
x = {_matlab_rows(model.prior_mean[:, None])};
P = {_matlab_rows(model.prior_cov)};
{begin}for k = 1:{"size(z, 2)" if model.m > 1 else "numel(z)"}
    if k > 1
{step}        x = F*x;
        P = F*P*F' + Q;
    end
    v = {z} - H*x{less};
    S = H*P*H' + R;
{far}    if ~any(isnan(v)){near}
        K = P*H'/S;
        x = x + K*v;
        P = (eye({model.n}) - K*H)*P*(eye({model.n}) - K*H)' + K*R*K';
    end
end"""


def _arduino(model: AffineModel, gain: np.ndarray, gate: float | None, unequal: UnequalSteps | None = None) -> str:
    a, _, _, c, d = model.matrices()
    names = [f"x{i + 1}" for i in range(model.n)]
    inputs = [f"z{j + 1}" for j in range(model.m)] if model.m > 1 else ["z"]
    p, v = [f"p{i + 1}" for i in range(model.n)], [f"v{j + 1}" for j in range(model.m)]
    arguments, offsets = ", ".join(f"double {z}" for z in inputs), [float(offset) for offset in d]
    first = dict.fromkeys(names, "0.0")
    widths = np.diag(model.prior_cov)
    for z, row, offset in zip(inputs, c, offsets, strict=True):
        level = names[int(np.argmax((row != 0.0) * widths))]  # of a sum the part that may begin anywhere
        sign = "-" if offset > 0.0 else "+"
        first[level] = f"{z} {sign} {_c(abs(offset))}" if offset else z
    lines = [
        f"// steady-state Kalman filter: call filter({', '.join(inputs)}) once each step; the first one begins",
        "// it needs double of 64 bits: on boards with an AVR (Uno, Mega) double is float, of seven digits",
        f"double {', '.join(names)};",
        "int begun = 0;",
        *([f"int {', '.join(f'far{j + 1} = 0' for j in range(model.m))};"] if gate is not None else []),
        f"void filter({arguments}) {{",
        "  if (!begun) {",
        f"    if ({' || '.join(f'{z} != {z}' for z in inputs)}) return;  // NaN",
        *(f"    {name} = {value};" for name, value in first.items()),
        "    begun = 1;",
        "    return;",
        "  }",
    ]
    lines += [f"  double {name} = {_products(row, names)};" for name, row in zip(p, a, strict=True)]
    lines += [
        f"  double {difference} = {z} - ({_products(row, p, offset)});"
        for difference, z, row, offset in zip(v, inputs, c, offsets, strict=True)
    ]
    if gate is None:
        lines += [f"  if ({difference} != {difference}) {difference} = 0.0;  // NaN" for difference in v]
    else:  # v = 0 for outliers, but after some in a row the level is another one
        s = np.diag(model.measurement_noise_cov) / (1.0 - np.einsum("ji,ij->j", c, gain))
        for j, (difference, limit) in enumerate(zip(v, gate * np.sqrt(s), strict=True)):
            is_missing = f"if ({difference} != {difference}) {difference} = 0.0; else"
            is_near = f"{difference} < {_c(limit)} && {difference} > -{_c(limit)}"
            skip = f"{{ far{j + 1}++; {difference} = 0.0; }}"
            lines.append(f"  {is_missing} if ({is_near}) far{j + 1} = 0; else if (far{j + 1} < {BURST}) {skip}")
    lines += [
        f"  {x} = {_products(np.array([1.0, *row]), [before, *v])};"
        for x, before, row in zip(names, p, gain, strict=True)
    ]
    return "\n".join([*lines, "}"])


LANGUAGES: dict[str, Callable[[AffineModel, np.ndarray, float | None, UnequalSteps | None], str]] = {
    "python": _python,
    "filterpy": _filterpy,
    "pykalman": _pykalman,
    "matlab": _matlab,
    ARDUINO: _arduino,
}
COMMENTS = {"matlab": "%", ARDUINO: "//"}


def _number(value: float) -> str:
    return f"{float(value):.12g}"


def _numbers(values: np.ndarray) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _rows(matrix: np.ndarray) -> str:
    return f"[{', '.join(map(_numbers, matrix))}]"


def _matlab_rows(matrix: np.ndarray) -> str:
    return f"[{'; '.join(' '.join(map(_number, row)) for row in matrix)}]"


def _less(offset: np.ndarray) -> str:
    """The subtraction of an offset in Python, or nothing for zero."""
    text = _number(offset[0]) if len(offset) == 1 else f"np.array({_numbers(offset)})"
    return f" - {text}" if offset.any() else ""


def _c(value: float) -> str:
    text = _number(value)
    return text if "." in text or "e" in text else f"{text}.0"


def _products(row: np.ndarray, names: list[str], offset: float = 0.0) -> str:
    """A sum of products without those of zero."""
    terms = [
        name if value == 1.0 else f"{_c(value)} * {name}"
        for value, name in zip(row, names, strict=True)
        if value != 0.0
    ]
    return " + ".join(terms + ([_c(offset)] if offset else [])) or "0.0"
