"""Bytes on the line to values and back, pure: no port is opened here."""
