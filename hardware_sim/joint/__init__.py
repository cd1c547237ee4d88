"""Two muscles at one joint, an agonist and an antagonist, each with a pair of electrodes: what their pulses make of it.

`draw_joint(seed)` draws a `Joint`, `Joint.truth` says all of it. `muscles` has the motor units that pulses reach and
the mechanics, `live` plays a joint pulse by pulse. Records off line: `stimrig.hardware_sim.joint_records`.
"""

from __future__ import annotations

from stimrig.hardware_sim.joint.draw import draw_joint
from stimrig.hardware_sim.joint.live import LiveJoint
from stimrig.hardware_sim.joint.muscles import Joint, JointMuscle

__all__ = ["Joint", "JointMuscle", "LiveJoint", "draw_joint"]
