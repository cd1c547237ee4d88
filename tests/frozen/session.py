"""Runs calls of the command line in one process: a call a line of JSON in, its answer a line out."""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
from typing import Any, TextIO

from tests.frozen.answers import PACKAGE


def answer(arguments: list[str]) -> dict[str, Any]:
    """Exit code, standard output and error of a call, its children's too."""
    main = importlib.import_module(f"{PACKAGE}.cli.main")
    sys.argv = ["stimrig", *arguments]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as error:
        before = os.dup(1), os.dup(2)
        os.dup2(out.fileno(), 1), os.dup2(error.fileno(), 2)
        try:
            code = main.run(arguments)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        finally:
            sys.stdout.flush(), sys.stderr.flush()
            os.dup2(before[0], 1), os.dup2(before[1], 2)
            os.close(before[0]), os.close(before[1])
        texts = []
        for file in (out, error):
            file.seek(0)
            texts.append(file.read().decode())
    return {"exit": code, "out": texts[0], "error": texts[1]}


def serve(calls: TextIO, answers: TextIO) -> None:
    """Until there are no more calls."""
    for line in calls:
        print(json.dumps(answer(json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    with os.fdopen(os.dup(0)) as calls, os.fdopen(os.dup(1), "w") as answers:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        serve(calls, answers)
