"""What of the rig's limits IEC 60601-2-10 speaks of: computed from rig/limits.py, never typed."""

from __future__ import annotations

import math

from deploy.technical_file.places import Row
from stimrig.rig.limits import HARD_LIMITS, SUM_LIMITS


def worst(load_ohm: float, area_cm2: float) -> dict[str, tuple[float, str]]:
    """The largest value and unit of each figure that any admitted pulses can reach on a load and an electrode.

    Both phases count. With charge Q of a phase and of a second bounded, energy and mean square grow with the current:
    they are largest at its limit, where the width is what the charge leaves.
    """
    rows = {**HARD_LIMITS, **SUM_LIMITS}
    current_a = rows["current_ma"].hi * 1e-3
    phase_c = min(rows["charge_per_phase_uc"].hi, rows["current_ma"].hi * rows["pulse_width_us"].hi * 1e-3) * 1e-6
    rms_ma = math.sqrt(2 * current_a * rows["charge_per_second_uc"].hi * 1e-6) * 1e3
    own = {name: (row.hi, row.unit) for name, row in rows.items()}
    return own | {
        "rms_current_ma": (rms_ma, "mA"),
        "rms_density_ma_cm2": (rms_ma / area_cm2, "mA/cm²"),
        "pulse_energy_mj": (2 * load_ohm * current_a * phase_c * 1e3, "mJ"),
        "peak_voltage_v": (current_a * load_ohm, "V"),
    }


def of_clauses(standard: Row) -> dict[str, tuple[float, str]]:
    """`worst` with the load and the electrode that the table of clauses names."""
    return worst(standard["load_ohm"], standard["electrode_area_cm2"])
