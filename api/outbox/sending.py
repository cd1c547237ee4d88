"""Sending files: what the centre lacks, oldest first, chunk by chunk from where it has got to."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from api.outbox.answers import Progress, Wanted, whole_number
from api.outbox.errors import RefusedError, UnreachableError, WrongAnswerError
from api.outbox.files import Files, Source
from api.outbox.link import Link

CHUNK = 8_000_000
PAGE = 100
MOST_ASKED = 1000


class Sending:
    """Sends a centre the files that it lacks.

    Attributes
    ----------
    queue : deque of Wanted
        What it lacked when it was last asked, without what is damaged here.
    asked : bool
        Whether it was asked since something new was told.
    """

    def __init__(self, link: Link, files: Files) -> None:
        self.link, self.files = link, files
        self.queue: deque[Wanted] = deque()
        self.asked = False
        self._other_offset = False

    def ask(self) -> None:
        """Learn what the centre lacks. Damaged files stand before the others until they are mended: more is asked."""
        limit = min(PAGE + len(self.files.damaged), MOST_ASKED)
        wanted = self.link.wanted(limit)
        self.queue = deque(each for each in wanted if self.files.source_known(each.sha256))
        self.asked = len(wanted) < limit  # else there is more after these

    def step(self, share: float = 1.0) -> bool:
        """Send a chunk, at most `share` of the largest; whether there may be more to do at once.

        Not at once after what cost a look at the disk and sent nothing: a centre that asks for the same again and
        again has no file read faster than one a rest.
        """
        if not self.queue:
            if self.asked:
                return False
            self.ask()
            if not self.queue:
                self.asked = True
                return False
        wanted = self.queue[0]
        source = self.files.source(wanted.sha256)
        if source is None:
            self.queue.popleft()
            return not self.files.unknown(wanted.sha256)
        if wanted.have > source.size:
            self.queue.popleft()
            raise WrongAnswerError(f"{self.link.url}: has more of {wanted.sha256[:12]}… than there is")
        self._send(wanted, source, max(1, int(CHUNK * share)))
        return wanted.have < source.size

    def _send(self, wanted: Wanted, source: Source, most: int) -> None:
        length = min(most, source.size - wanted.have)
        try:
            given = self.link.send(wanted.sha256, wanted.have, source.pieces(wanted.have, length), length)
        except RefusedError as error:
            self._refused(wanted, source, error)
            return
        except (UnreachableError, OSError):
            self.files.doubt(wanted.sha256)  # it may have been cut here
            raise
        self._other_offset = False
        self._took(wanted, source, length, given)

    def _took(self, wanted: Wanted, source: Source, length: int, given: Progress) -> None:
        if given.whole and given.have == source.size:
            self.queue.popleft()
        elif given.whole or given.have != wanted.have + length or length == 0:
            self.queue.clear()
            self.asked = False
            raise WrongAnswerError(f"{self.link.url}: counts the bytes of {wanted.sha256[:12]}… otherwise than the rig")
        else:
            self.queue[0] = replace(wanted, have=given.have)

    def _refused(self, wanted: Wanted, source: Source, error: RefusedError) -> None:
        """Go on from where the centre says it is, once; else it is asked again, later."""
        if error.code == "other-offset" and not self._other_offset:
            have = whole_number(error.said, "have_bytes")
            if have <= source.size:
                self._other_offset = True
                self.queue[0] = replace(wanted, have=have)
                return
        self._other_offset = False
        self.files.doubt(wanted.sha256)
        self.queue.clear()
        self.asked = False
        raise error
