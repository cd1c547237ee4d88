"""The verbs: one file each, with a function of its name, or `register(app)` where it has verbs of its own."""
