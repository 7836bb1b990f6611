"""Pages as they stand, on NumPy's arrays: what the filters made of them are compared with."""

from math import prod

import numpy as np

from thruster_env.core.checks import covariance_root


class OfArrays:
    """A model as a page sees it, of NumPy's arrays."""

    def __init__(self, model, own=(), constants=None):
        self._model, self._c, self.own = model, model.constants if constants is None else constants, own
        self.Q, self.R = model.process_noise_cov, model.measurement_noise_cov
        self.Q_root, self.prior_root = covariance_root(self.Q), covariance_root(model.prior_cov)
        self.state_angles, self.measurement_angles = model.shape.state_angles, model.shape.measurement_angles
        self.extras, self.feed, self.turns = {}, 0, ()

    def at(self, constants):
        return OfArrays(self._model, self.own, tuple(constants))

    def at_measurement(self, z):
        return self, z

    def f(self, x, u):
        if x.ndim == 2:
            return np.stack([self.f(point, u) for point in x.T], axis=1)
        return np.array(self._model.transition(tuple(x), tuple(u), self._c))

    def F(self, x, u):  # noqa: N802
        return np.array(self._model.transition_jacobian(tuple(x), tuple(u), self._c))

    def h(self, x):
        if x.ndim == 2:
            return np.stack([self.h(point) for point in x.T], axis=1)
        return np.array(self._model.observe(tuple(x), self._c))

    def H(self, x):  # noqa: N802
        return np.array(self._model.observe_jacobian(tuple(x), self._c))


def parameters_of(page, numbers):
    """The parameters of a page, of the filter's own numbers."""
    return page.parameters(lambda place, shape: np.reshape(numbers[place : place + prod(shape)], shape)[()])


def run_page(filter_, inputs, measurements):
    """Means, covariances, innovations, their covariances and log-likelihoods of one run, by the page itself."""
    page, model = filter_.written_page, filter_.kernel_model
    equations = OfArrays(model, parameters_of(page, np.array(filter_.own_parameters)))
    x, p, found = model.prior_mean, model.prior_cov, []

    def kept(results):
        *values, changed = results if isinstance(results[-1], dict) else (*results, {})
        equations.extras = equations.extras | changed
        return values

    if page.initial is not None:
        equations.extras = page.initial(equations)
    for k, z in enumerate(measurements):
        if k > 0:
            flying = [x, p] if page.represent is None else together(page.represent(equations, x, p))
            for _ in range(model.substeps):
                flying = kept(together(page.propagate(equations, *flying, inputs[k - 1])))
            x, p = kept(page.add_process_noise(equations, *flying))
        x, p, *told = kept(page.update(equations, x, p, z))
        found.append((x, p, *told))
    return [np.array(part) for part in zip(*found, strict=True)]


def together(results):
    return list(results) if isinstance(results, tuple) else [results]
