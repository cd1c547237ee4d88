"""Model versions, what is known about each, and their approval."""
