"""`python -m stimrig.api.web`: the service. Worker processes do not import a module of this name again."""

import sys

from stimrig.api.web.server import main

if __name__ == "__main__":
    sys.exit(main())
