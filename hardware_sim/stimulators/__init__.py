"""Stimulators: a firmware is one file with a class `Firmware`, found by scanning this folder."""
