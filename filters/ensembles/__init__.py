"""Filters whose belief is an ensemble of states, each member as likely as any other.

A page is written for one member; `mean` and `covariance` are what members share, and cut it into loops. Inflation
and relaxation are functions of a page that return a page. Rotations, and analyses by parts (localisation, the rank
histogram), are steps after the page, and are neither in C nor on tensors. A window of the iterated filter
estimates process noise, too: the published method assumes motion without noise, and noise that were redrawn would
spoil a linear model.
"""
