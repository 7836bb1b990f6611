"""
Tutorial: a network in a model
==============================

A thruster's log shows friction that its model lacks. There is no equation for it, so a small network
represents it in the model's transition, and torch learns it from the innovations of a filter.
"""

# %%
# The log
# -------
#
# Runs from rest with voltages that change every 0.1 s; thrust and motor speed are measured. The truth contains
# the friction of a shaft seal, a Stribeck curve: large at low speed, smaller where a film of water carries the
# shaft.

import math

import matplotlib.pyplot as plt
import numpy as np
import torch

import filters
from filters import make_filter, run, thruster_model
from thruster_env.core.streams import episode_keys
from thruster_env.model.simulate import simulate
from thruster_env.thruster.model import transition

RUNS = 60
STEPS = 30
ROUNDS = 60


def friction(speed):
    """Deceleration [rad/s^2] at a motor speed [rad/s]."""
    film = math.exp(-((speed / 40.0) ** 2))
    return (1500.0 + 2000.0 * film) * math.tanh(speed / 30.0)


def rubbing(x, u, c):
    speed, flow = transition(x, u, c)
    return speed - c.substep * friction(x[0]), flow


model = thruster_model(
    sensors=["thrust", "speed"], measurement_noise_cov=[0.25, 1.0], substeps=1
)
truth = model.replace(transition=rubbing, transition_jacobian=None)


def record(seed):
    drawn = np.random.default_rng(seed).uniform(-12.0, 12.0, (RUNS, STEPS // 10, 1))
    voltages = np.repeat(drawn, 10, axis=1)
    return voltages, simulate(truth, episode_keys(range(seed, seed + RUNS)), voltages)


u, recorded = record(0)
z = recorded.measurements
u.shape, z.shape

# %%
# More process noise
# ------------------
#
# Without a network, more process noise tells the filter that the motor is uncertain. ``filters.torch`` makes a
# filter on tensors, and its ``log_likelihood`` is the compiled recursion with the exact gradient along Q and R.
# Any optimiser of torch can use it, here along the logarithms of the variances in Q.

ekf = filters.torch(make_filter("ekf", model))
log_q = torch.tensor(np.log(np.diag(model.process_noise_cov)), requires_grad=True)
optimiser = torch.optim.Adam([log_q], lr=0.3)
for _ in range(60):
    optimiser.zero_grad()
    noisy = ekf.replace(process_noise_cov=torch.diag(log_q.exp()))
    loss = -noisy.log_likelihood(u, z).mean()
    loss.backward()
    optimiser.step()

more_noise = model.replace(process_noise_cov=log_q.exp().detach().numpy())
print(
    f"standard deviation of the motor's noise: {log_q[0].exp() ** 0.5:.1f} rad/s a step, not 1"
)

# %%
# A network
# ---------
#
# ``transition`` takes and returns one tensor for each state, with an entry for each run. The thruster's
# equations consist of ``+ - * /`` and ``abs``, which work on tensors, so the network is added to them. The sigma
# points of a ``ukf`` are further entries, and no Jacobian is needed; for an ``ekf`` torch would compute the
# network's. Q is learned with the network: what the network explains is no longer noise.

torch.manual_seed(0)
net = torch.nn.Sequential(
    torch.nn.Linear(1, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1)
).double()


def learned_friction(speed):
    return 1000.0 * net(speed[..., None] / 50.0)[..., 0]


def with_network(x, u, c):
    speed, flow = transition(x, u, c)
    return speed - c.substep * learned_friction(x[0]), flow


ukf = filters.torch(make_filter("ukf", model), transition=with_network)
log_q = log_q.detach().requires_grad_()
optimiser = torch.optim.Adam(
    [{"params": net.parameters(), "lr": 0.04}, {"params": [log_q], "lr": 0.1}]
)
for _ in range(ROUNDS):
    optimiser.zero_grad()
    learned = ukf.replace(process_noise_cov=torch.diag(log_q.exp()))
    loss = -learned.run(u, z).log_likelihoods.mean()
    loss.backward()
    optimiser.step()
print(
    f"standard deviation of the motor's noise: {log_q[0].exp() ** 0.5:.1f} rad/s a step"
)

# %%
# On other runs
# -------------
#
# Log-likelihood per step and RMSE on held-out runs, compared with a filter that has the equation of the friction.

u, recorded = record(1000)
z = recorded.measurements
with torch.no_grad():
    of_network = learned.run(u, z)
estimates = {
    "the model": run(make_filter("ukf", model), None, u, z),
    "with more noise": run(make_filter("ukf", more_noise), None, u, z),
    "with a network": of_network,
    "the true equation": run(make_filter("ukf", truth), None, u, z),
}
for name, result in estimates.items():
    errors = np.asarray(result.means) - recorded.states
    speed, flow = np.sqrt((errors**2).mean(axis=(0, 1)))
    level = float(result.log_likelihoods.mean())
    print(f"{name:18} {level:7.2f}   {speed:5.2f} rad/s   {flow:.4f} m/s")

# %%
# With more noise the filter trusts only its sensors. The network makes its model right, up to the
# speeds in the log.

speeds = np.linspace(-160.0, 160.0, 161)
with torch.no_grad():
    curve = learned_friction(torch.tensor(speeds))
figure, axes = plt.subplots(figsize=(6, 3))
axes.plot(speeds, [friction(speed) for speed in speeds], label="truth")
axes.plot(speeds, curve, "--", label="network")
axes.set(xlabel="motor speed [rad/s]", ylabel="friction [rad/s$^2$]")
axes.legend()
figure.tight_layout()

# %%
# Everything else that is a tensor has derivatives, too: :doc:`/howto/torch`.
