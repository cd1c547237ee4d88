"""The machine on which the rig runs: threads, clock, serial ports, CAN adapters, files, sockets. Nothing here decides
about a pulse."""
