"""An array of small electrodes on a limb: which element, or pair of elements, gives most torque and least besides.

    array = draw_array(seed, elements=16)
    session = array.session(1)
    session.stimulate((6,), width_us=300, current_ma=12)      # Seen: what an experimenter learns, with its errors
    session.truth((6, 7), width_us=300, current_ma=12)        # Truth: what the limb does
    session.best(utility, widths_us, currents_ma)             # of all choices, by evaluating each

`limb` has the nerves under the skin and what current does to them, `session` the array upon it on one day, `live`
plays it pulse by pulse.
"""

from __future__ import annotations

from stimrig.hardware_sim.electrode_array.live import ArrayMuscle
from stimrig.hardware_sim.electrode_array.session import Best, ElectrodeArray, Seen, Session, Truth, draw_array

__all__ = ["ArrayMuscle", "Best", "ElectrodeArray", "Seen", "Session", "Truth", "draw_array"]
