"""What the tissue of an unstimulated elbow does, h(x, ẋ): one law a file with a class `Law`, found by scanning.

Torque in N·m, flexion positive; angle 0 is the straight arm.
"""
