#!/usr/bin/env python3
"""`stimrig backup` by the name that it had before 1.0: `backup.py make`, `verify` and `restore`. Use the verb."""

import sys

from stimrig.__main__ import main

if __name__ == "__main__":
    verb = ["create" if word == "make" else word for word in sys.argv[1:2]]
    sys.argv[1:] = ["backup", *verb, *sys.argv[2:], *(["--json"] if verb in (["create"], ["verify"]) else [])]
    main()
