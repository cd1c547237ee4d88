"""A whole rig on one virtual clock and one seeded source of chance (docs/simulator.md)."""
