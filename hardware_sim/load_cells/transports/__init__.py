"""A transport is one file with a class `Transport`, found by scanning this folder."""
