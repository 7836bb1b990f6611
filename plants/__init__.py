"""What all plants share: the state-space model, truth drawn from it, disturbances, and the mechanics of an env."""

from numerics.compiled import may_be_inlined

may_be_inlined(__name__, "numerics")
