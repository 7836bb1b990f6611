"""Training of estimators with a network on runs of a problem; this needs torch.

training   the filter that it starts from, the loop with checks on validation runs, and estimators beside filters
           on held-out runs, also longer and noisier ones
"""
