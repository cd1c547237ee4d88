"""The machine on which the rig runs: threads, clock, serial ports, CAN adapters, files. Nothing here decides."""
