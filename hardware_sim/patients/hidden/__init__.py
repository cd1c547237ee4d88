"""Muscles with something hidden in them, drawn by a seed: physics written apart from the library that is to find it."""
