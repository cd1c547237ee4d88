"""The REST client: what a program does with a running service."""
