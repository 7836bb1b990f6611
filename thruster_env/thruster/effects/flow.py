"""Ambient flow U_0 along the thruster's axis [m/s]: signals that add to the constant `ambient_velocity`."""

from __future__ import annotations

from thruster_env.effects.effects import Registry
from thruster_env.effects.signals import GaussMarkov, Gusts, RecordedSignal, Sinusoid

FLOW_SIGNALS = Registry("flow")
for _name, _signal in {
    "sinusoid": Sinusoid,
    "gauss-markov": GaussMarkov,
    "gusts": Gusts,
    "recorded": RecordedSignal,
}.items():
    FLOW_SIGNALS.register(_name)(_signal)
