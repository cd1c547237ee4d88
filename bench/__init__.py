"""Figures measured on this machine: `make bench`, or `python -m bench NAME`."""
