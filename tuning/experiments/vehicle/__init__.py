"""Two papers on the estimation of an underwater vehicle's path, repeated with many runs.

`printed` is the form of the papers' tables, `paths` has the inputs, `models` the vehicle, `pose` the path from
velocities. `mean_propagation` and `own_attitude` are filters of these studies only, `estimators` and `tasks` the
filters of each study. `experiment` runs all of them on the same runs, `scores` has the results, `findings` the
printed values beside them, `statements` the conclusions, `figure` the pictures of the paths.
"""
