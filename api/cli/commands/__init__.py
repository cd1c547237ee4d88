"""The verbs: one file each, with `register(app)`; a new file here is a new verb."""
