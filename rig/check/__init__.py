"""The check of a rig: each wire, rate, sign, and stop, on a dummy load or the emulator. `docs/rig-check.md`.

Each step is one file in `steps/`, found by scanning: adding one touches no other file.
"""
