"""Random numbers of a plant's page: those of `core.streams`, of floats and arrays or as numbers of a graph."""

from __future__ import annotations

from typing import Any

from thruster_env.core.streams import logarithm, logarithm_of_parts, polar, uniform_block
from thruster_env.graphs.graphs import Number


class Draws:
    """The random numbers of a copy at a step.

    Args:
        key: of the copy's episode, two words: floats, arrays of one shape, or Numbers.
        step: the number of the step.
    """

    def __init__(self, key: tuple, step: Any):
        """See the class."""
        self.key, self.step = key, step

    def uniforms(self, stream: int, block: int = 0, step: Any = None) -> tuple:
        """Four uniform numbers in (0, 1) of a block of a stream; of another step, if one is given."""
        step = self.step if step is None else step
        if not isinstance(self.key[0], Number):
            return uniform_block(block, step, stream, *self.key)
        graph = self.key[0].graph
        words = graph.make("philox", *map(graph.number, (float(block), step, float(stream), *self.key)))
        return tuple(graph.make("entry", words, k) for k in range(4))

    def normals(self, stream: int, count: int = 4, block: int = 0, step: Any = None) -> tuple:
        """Standard normals, `count` of them, from a block of a stream on."""
        normals: list = []
        for k in range(block, block - (-count // 4)):
            u_0, u_1, u_2, u_3 = self.uniforms(stream, k, step)
            normals += polar(_logarithm(u_0), u_1, _logarithm(u_2), u_3)
        return tuple(normals[:count])


def _logarithm(x):
    if not isinstance(x, Number):
        return logarithm(x)
    return logarithm_of_parts(x.graph.make("exponent", x), x.graph.make("mantissa", x))
