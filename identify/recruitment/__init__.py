"""Recruitment curves: a basis each, torque at rest state against pulse width, zero at zero width."""
