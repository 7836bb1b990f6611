"""What every room stands on: compilation, small algebra, random streams, threads, checks, files and plots."""

from numerics.compiled import may_be_inlined

may_be_inlined(__name__)
