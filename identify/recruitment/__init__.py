"""Recruitment curves: steady-state torque as a function of pulse width, zero at zero width; one file per basis."""
