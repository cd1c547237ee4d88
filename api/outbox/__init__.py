"""What the rig tells a centre: written with the rows it tells of, pushed by a process of its own (decision 0013)."""
