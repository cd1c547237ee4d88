"""Property tests know no time: the machine is shared, and how long an example takes is no property.

Here, above all tests: the profile has to be loaded before the first of them is imported.
"""

from hypothesis import HealthCheck, settings

settings.register_profile("shared-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared-machine")
