"""How active torque depends on the angle: one law a file with a class `Law`, found by scanning.

A law gives a share that is not yet scaled; `stimrig.hardware_sim.arm.tissue` makes it 1 at the reference angle.
"""
