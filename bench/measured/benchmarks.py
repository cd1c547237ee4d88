"""Two benchmarks of nonlinear identification, with figures that others published.

Cascaded tanks that run over (Schoukens, Mattsson, Wigren, Noël 2016; free run, RMSE: 0.191 V grey-box, 0.306 V
CT-SUBNET, 0.396 V GRU) and coupled electric drives (Wigren, Schoukens 2017; 0.115 and 0.074 ticks/s).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.measured import Place

_CTS = "examples/CTS/data/CascadedTanksFiles/dataBenchmark.csv"
TANKS = Place("forgi86/sysid-neural-unc", "4652931", _CTS)
DRIVES = Place(
    "Agnibha-31/AURA-Membership-Function-Neuro-Fuzzy-Process-Control-Automation",
    "91e4b5c",
    "Coupled Eletric Drives Datasets/DATAUNIF.csv",
)
Run = tuple[np.ndarray, np.ndarray]


def tanks(data: Path | None = None) -> list[Run]:
    """Pump's voltage and level's voltage of 1024 samples, 4 s apart: of the run to fit, and of that to be predicted."""
    u_fit, u_new, y_fit, y_new = np.genfromtxt(TANKS.local(data), delimiter=",", skip_header=1)[:, :4].T
    return [(u_fit, y_fit), (u_new, y_new)]


def drives(data: Path | None = None) -> list[Run]:
    """Motors' voltage and speed of the pulley without its sign, ticks/s, of two runs of 500 samples, 20 ms apart."""
    u_low, u_high, y_low, y_high = np.genfromtxt(DRIVES.local(data), delimiter=",", skip_header=1)[:, :4].T
    return [(u_low, y_low), (u_high, y_high)]
