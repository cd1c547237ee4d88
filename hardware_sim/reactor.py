"""Waiting on several descriptors at once, with a time limit finer than epoll's millisecond."""

from __future__ import annotations

import select
from collections.abc import Callable
from typing import Protocol


class HasDescriptor(Protocol):
    """A socket or a pseudo-terminal."""

    def fileno(self) -> int:
        """The descriptor to wait on."""
        ...


class Reactor:
    """Calls a function for each descriptor that has something to read."""

    def __init__(self) -> None:
        self._readers: dict[int, Callable[[], None]] = {}

    def add(self, source: HasDescriptor, on_readable: Callable[[], None]) -> None:
        """Call `on_readable` whenever `source` has something to read."""
        self._readers[source.fileno()] = on_readable

    def remove(self, source: HasDescriptor) -> None:
        """Forget `source`; to be called before it is closed."""
        self._readers.pop(source.fileno(), None)

    def poll(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` for something to read, and serve all that have."""
        readable, _, _ = select.select(list(self._readers), (), (), max(0.0, timeout_s))
        for descriptor in readable:
            on_readable = self._readers.get(descriptor)
            if on_readable is not None:  # an earlier callback may have closed it
                on_readable()
