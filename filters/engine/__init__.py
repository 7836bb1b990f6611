"""How filters run: their memory, compiled steps, batches and sessions.

A belief is one row of floats and, for an ensemble, a table with a column per member; a model's numbers are a row.
A batch of a filter with a page runs 32 beliefs side by side, and each instruction is for eight of them: an
extended Kalman step takes 0.05 us of a core instead of 0.19. A filter restarts from the prior if its estimate is
not finite or a variance is negative. It does not check for an indefinite P with positive variances: a
factorisation in every step would cost as much as the update, and `form="square-root"` excludes it.
"""
