"""Methods that find Q, R and other numbers of a filter; an import of the package registers them all."""

from tuning.methods import gradients, innovations, searches  # noqa: F401 - their methods register themselves
