"""The log-likelihood of a page's innovations with its derivatives along parameters of the model.

Derivatives are made from the page by the rules of matrix calculus and of `thruster_env.graphs`. Tuning follows
them in three steps: a `ParametricModel` makes a model and its slopes from parameters, an objective its value,
gradient and information from runs, and `tuning.likelihood.ascent` climbs. `filters.sensitivity` differentiates
the *model* along each parameter in one recursion, of which Fisher's scoring needs a tenth of the evaluations of
L-BFGS-B.
"""
