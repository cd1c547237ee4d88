"""What holds or moves the forearm: one file each with a class `Mover`, found by scanning this folder."""
