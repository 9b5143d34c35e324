"""For all tests."""

from hypothesis import settings

# A machine that others use too stands still for half a second now and then: an example is not wrong for being late.
settings.register_profile("shared machine", deadline=None)
settings.load_profile("shared machine")
