"""Filters whose belief is an ensemble of states, each member as likely as any other.

A page is written for one member; `mean` and `covariance`, which all members share, divide it into loops over the
members. Inflation and relaxation are functions of a page that return a page. Rotations, and analyses by parts
(localisation, the rank histogram), are steps after the page, and are neither in C nor on tensors. The window of
the iterated filter also estimates process noise: the published method assumes motion without noise, and
redrawing the noise would change the estimates of a linear model.
"""
