"""`python -m stimrig`: what the console script `stimrig` runs."""

from stimrig.api.cli.main import main

main()
