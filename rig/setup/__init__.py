"""A new rig file: finds ports and adapters without opening them, asks, and writes the file with comments.

A process of its own, `python -m stimrig.rig.setup`; `stimrig rig init` starts it. Nothing here can move current.
"""
