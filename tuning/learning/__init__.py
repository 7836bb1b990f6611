"""Training of estimators with a network on runs of a problem; this needs torch.

starting   the filter that a training starts from, and the scales of its quantities
loss       what a training minimises
settings   how, with all defaults; this alone needs no torch
training   the loop: windows of many runs, checks on validation runs, the best estimator found
variants   runs that are longer or noisier than those of the training
standings  filters and estimators on held-out runs and on these variants
"""
