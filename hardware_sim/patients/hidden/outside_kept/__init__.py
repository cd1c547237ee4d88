"""Effects no library names, kept from whoever tunes the diagnosis; only the bench's set `kept` draws them.

The files' names tell nothing, on purpose. Don't read them while working on `identify`.
"""
