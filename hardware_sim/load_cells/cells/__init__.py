"""A cell is one file with a class `Cell`, found by scanning this folder."""
