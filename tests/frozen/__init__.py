"""What users hold, kept as it was: `python -m tests.frozen make` writes it, `check` compares it (README.md)."""
