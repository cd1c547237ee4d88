"""How active torque depends on the velocity: one law a file with a class `Law`, found by scanning.

The muscle is a flexor: it shortens at positive velocities. Each law is 1 at rest.
"""
