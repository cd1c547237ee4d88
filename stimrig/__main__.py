"""`stimrig` and `python -m stimrig`: Ctrl-C ends it from its first moment on, while libraries are still loaded."""

from __future__ import annotations

import signal
import sys

from stimrig.api.cli.errors import exit_interrupted


def main() -> None:
    """Run the command line."""
    signal.signal(signal.SIGINT, exit_interrupted)
    from stimrig.api.cli.main import main as run

    try:
        run(sys.argv[1:])
    except KeyboardInterrupt:
        exit_interrupted()


if __name__ == "__main__":
    main()
