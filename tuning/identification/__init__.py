"""A plant's numbers from its logs: maximum likelihood over a filter's innovations, and what the data determine."""

from tuning.identification.identify import identify
from tuning.identification.result import Identification

__all__ = ["Identification", "identify"]
