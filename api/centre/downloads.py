"""A file of the bucket, handed out once it has been read whole and found to be what its name says."""

from __future__ import annotations

import asyncio
import os
import re
import tempfile
from collections.abc import Iterator
from typing import IO

from fastapi.responses import Response, StreamingResponse

from stimrig.api.centre import check
from stimrig.api.centre.bucket import PIECE, BucketError, MissingError
from stimrig.api.centre.context import Context
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.store.centre_tables import CentreFile

IN_MEMORY = 8_000_000


async def hand_out(context: Context, sha256: str | None, name: str, kind: str) -> Response:
    """The answer. Raises ApiError: 404 it has not come yet; 500 `file-damaged`; 503 the bucket cannot be read."""
    row = await asyncio.to_thread(context.store.get, CentreFile, sha256) if sha256 else None
    if row is None or sha256 is None:
        raise NotFoundError("file", name, "The rig has not sent it yet; what is waiting stands on the page of rigs.")
    async with context.downloads:
        copy = await context.with_bucket(_read, context, sha256)
    length = copy.seek(0, os.SEEK_END)
    copy.seek(0)
    safe = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
    headers = {
        "Content-Disposition": f'attachment; filename="{safe}"', "Content-Length": str(length), "ETag": f'"{sha256}"',
    }  # fmt: skip
    return StreamingResponse(_pieces(copy), media_type=kind, headers=headers)


def _read(context: Context, sha256: str) -> IO[bytes]:
    copy = tempfile.SpooledTemporaryFile(IN_MEMORY, dir=str(context.settings.exports_dir))  # noqa: SIM115
    try:
        if context.bucket.copy(sha256, copy):
            return copy  # pyright: ignore[reportReturnType]
        words = "its content is another than its name says"
    except MissingError:
        words = "it is not in the bucket"
    except BucketError as error:
        copy.close()
        raise ApiError(503, "bucket-failed", "The file cannot be read at the moment", f"{error}.") from error
    copy.close()
    check.note(context.store, context.clock, sha256, False, words)
    detail = f"The file {sha256[:12]}… is no longer what was received: {words}. Its rigs are asked for it again."
    raise ApiError(500, "file-damaged", "The file differs from its hash", detail)


def _pieces(copy: IO[bytes]) -> Iterator[bytes]:
    with copy:
        while piece := copy.read(PIECE):
            yield piece
