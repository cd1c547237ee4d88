"""Muscles and arms that the benches and tests identify: records made without the wire, and muscles of other physics."""
