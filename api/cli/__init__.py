"""The command line: `stimrig` and its verbs."""
