"""The rig: owns the stimulator and the load cell, in a process of its own."""
