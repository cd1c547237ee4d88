"""A second socket, for stops alone, beside the first one (`SOCKET.stop`): nothing else can fill it.

It has an event loop in a thread of its own and threads of its own. Requests, previews, subscribers and half-open
connections of the other socket share nothing with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pydantic import ValidationError

from rig.control.crowd import Crowd
from rig.control.replies import id_of, refusal, to_line, unforeseen, wrong
from rig.errors import ConfigError, RigError
from rig.messages import Reply, StopEvidence, StopRequest

log = logging.getLogger("rig.stop")

Stop = Callable[[str, str], StopEvidence]
WORKERS = 32
"""Stops whose evidence is waited for at the same time; the first of them has stopped already."""
LONGEST_LINE = 16_384
MOST_SILENT, MOST_SPEAKING = 32, 64


class StopDoor:
    """Takes stops.

    Parameters
    ----------
    stop
        Stops the rig (reason, by); waits for the evidence.
    """

    def __init__(self, stop: Stop) -> None:
        self._stop = stop
        self._crowd = Crowd(MOST_SILENT, MOST_SPEAKING)
        self._pool = ThreadPoolExecutor(WORKERS, "stop")
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, name="stop-door", daemon=True)

    def open(self, path: Path) -> None:
        """Listen. Raises ConfigError."""
        self._thread.start()
        try:
            path.unlink(missing_ok=True)
            asyncio.run_coroutine_threadsafe(self._listen(path), self._loop).result()
            path.chmod(0o660)
        except OSError as error:
            raise ConfigError(f"socket: {path}: {error.strerror or error}; a short path in a writable folder") from None

    def close(self) -> None:
        """Listen no longer; stops that are being answered are waited for."""
        self._pool.shutdown()
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._loop.close()

    async def answer(self, line: bytes) -> Reply:
        """Stop, and what came of it."""
        try:
            request = StopRequest.model_validate_json(line)
        except ValidationError as error:
            return wrong(id_of(line), error)
        try:
            loop = asyncio.get_running_loop()
            evidence = await loop.run_in_executor(self._pool, self._stop, request.reason, request.by)
            return Reply(id=request.id, ok=True, body=evidence.model_dump(mode="json"))
        except RigError as error:
            return refusal(request.id, error)
        except Exception as error:
            log.exception("a stop failed")
            return unforeseen(request.id, error)

    async def _listen(self, path: Path) -> None:
        self._server = await asyncio.start_unix_server(self._serve, path, limit=LONGEST_LINE, backlog=512)

    async def _end(self) -> None:
        self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        self._crowd.enter(writer.transport)
        try:
            while line := await reader.readline():
                self._crowd.spoke(writer.transport)
                writer.write(to_line(await self.answer(line)))
        except (OSError, ValueError) as error:
            log.warning("client let go: %s", error)
        finally:
            self._tasks.discard(task)
            self._crowd.leave(writer.transport)
            with contextlib.suppress(OSError):
                writer.close()
