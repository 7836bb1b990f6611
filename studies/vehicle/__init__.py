"""Two papers on the estimation of an underwater vehicle's path, done again with many runs.

`printed` is the form of what the papers print, `paths` what the vehicle does, `models` what it is, `pose` how a
path follows from velocities. `mean_propagation` and `own_attitude` are filters that serve these studies alone,
`estimators` and `tasks` say which filters run where. `experiment` runs them all on the same runs, `scores` is what
is kept, `findings` sets printed values beside it, `statements` says what it means, `figure` draws the paths.
"""
