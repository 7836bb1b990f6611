"""What all other packages use: compilation, matrix algebra, random streams, threads, checks, files, plots."""

from thruster_env.numerics.compiled import may_be_inlined

may_be_inlined(__name__)
