"""A plant's numbers from its logs: maximum likelihood over a filter's innovations, and what the data determine."""

from tuning.identification.identify import identify
from tuning.identification.profiles import Profile, profile_figure, profiles
from tuning.identification.result import Identification
from tuning.identification.validation import Validation, validate

__all__ = ["Identification", "Profile", "Validation", "identify", "profile_figure", "profiles", "validate"]
