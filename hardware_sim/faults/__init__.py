"""Faults that a test can switch on: a fault is one function marked `@fault` in any file of this folder."""
