"""Training of estimators with a network on runs of a problem; this needs torch.

starting   the filter that a training starts from, and the scales of its quantities
loss       what a training minimises
training   the loop: windows of many runs, checks on validation runs, the best estimator found
"""
