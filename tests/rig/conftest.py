"""Property tests have no deadline: the machine is shared, and time is no property."""

from hypothesis import settings

settings.register_profile("shared-machine", deadline=None)
settings.load_profile("shared-machine")
