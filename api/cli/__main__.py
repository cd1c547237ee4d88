"""`python -m api.cli`: what the console script `stimrig` runs."""

from api.cli.main import main

main()
