"""The REST client: the rig, participants, tests, recordings, and all that `Models` does."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from stimrig.api.client.documents import Note, Participant, SessionTest
from stimrig.api.client.errors import NotCompleted, NotFound
from stimrig.api.client.models import POLL_S, Models

OUTLOOK_S = 300.0
"""So long a busy service may take to say what an adaptive test can reach; usually it takes a few seconds."""


class Client(Models):
    """What a program does with a running service. Each method is one request, or says otherwise; nothing is retried.

    `request`, `get` and `post` reach every other route of docs/api.md.

    Examples
    --------
    >>> with Client("http://127.0.0.1:8000", token) as client:  # doctest: +SKIP
    ...     client.make_participant("P017")
    ...     test = client.run_test("P017")
    ...     client.approve(test["model_id"], "good fit")

    Raises
    ------
    ServiceError
        Each method: `Unreachable` without an answer, else a subclass of `Refused` with title, detail and status.
    """

    # ---- the service and its rig

    def health(self) -> dict[str, Any]:
        """Whether the service and its rig answer; needs no token."""
        return self.get("/health")

    def rig(self) -> dict[str, Any]:
        """State, devices, newest torque and its age."""
        return self.get("/v1/rig")

    def stop(self, reason: str = "") -> dict[str, Any]:
        """Stop stimulation. Returns only if the rig confirms that stimulation has stopped."""
        return self.post("/v1/stop", json={"reason": reason} if reason else {})

    def lock(self) -> None:
        """Lock the session of a person at once. A token has none to lock: `Conflict`."""
        self.request("POST", "/v1/sessions/lock")

    def effects(self) -> list[dict[str, Any]]:
        """The library of effects of the service."""
        return self.get("/v1/effects")["effects"]

    def issue_token(self, name: str, scopes: Sequence[str]) -> str:
        """A new token for a program; only an administrator may do this."""
        return self.post("/v1/tokens", json={"name": name, "scopes": list(scopes)})["token"]

    # ---- participants

    def participants(self, q: str = "", archived: bool | None = None) -> list[Participant]:
        """All participants, most recent first. `q`: a part of the code; `archived`: only those that are, or are not."""
        given = {"q": q or None, "archived": archived}
        return self.get("/v1/participants", params={key: value for key, value in given.items() if value is not None})

    def participant(self, code: str) -> Participant:
        """One participant with its limits."""
        return self.get(f"/v1/participants/{code}")

    def make_participant(
        self, code: str, profile: dict[str, float] | None = None, side: str | None = None, muscle: str | None = None,
        placement: str | None = None,
    ) -> Participant:  # fmt: skip
        """Make a participant: a code, never a name.

        Parameters
        ----------
        code : str
            Letters, digits, - and _.
        profile : dict, optional
            current_ma, max_pulse_width_us, max_torque_nm.
        side : str, optional
            "left" or "right".
        muscle : str, optional
            As "biceps brachii".
        placement : str, optional
            Of the electrodes; with side and muscle the site, to which models belong.
        """
        more = {"profile": profile, "side": side, "muscle": muscle, "placement": placement}
        return self.post(
            "/v1/participants", json={"code": code, **{key: value for key, value in more.items() if value}}
        )

    def set_muscle(
        self, code: str, side: str | None, muscle: str | None, placement: str | None = None
    ) -> Participant:  # fmt: skip
        """Say which site is stimulated; refused where a calibration would be lost by it."""
        site = {"side": side, "muscle": muscle, "placement": placement}
        return self.request("PUT", f"/v1/participants/{code}/muscle", json=site).json()

    def archive(self, code: str) -> Participant:
        """Put a participant into the archive: no test starts any more, and nothing is deleted."""
        return self.post(f"/v1/participants/{code}/archive")

    def unarchive(self, code: str) -> Participant:
        """Take a participant out of the archive."""
        return self.post(f"/v1/participants/{code}/unarchive")

    # ---- notes

    def notes(self, participant: str) -> list[Note]:
        """The notes of a participant, newest first, the struck ones among them."""
        return self.get(f"/v1/participants/{participant}/notes")

    def add_note(self, participant: str, kind: str, text: str = "", **more: Any) -> Note:
        """Write a note. `more`: `test_id`, and the time in that test as `at_s`, or `now=True` while it runs."""
        return self.post(f"/v1/participants/{participant}/notes", json={"kind": kind, "text": text, **more})

    def strike_note(self, participant: str, note_id: str) -> Note:
        """Mark a note as wrong; it stays readable."""
        return self.post(f"/v1/participants/{participant}/notes/{note_id}/strike")

    def ensure_participant(self, code: str) -> Participant:
        """The participant; makes it if there is none (two requests)."""
        try:
            return self.participant(code)
        except NotFound:
            return self.make_participant(code)

    def set_limits(self, code: str, **limits: float) -> Participant:
        """Change the limits that are named; the others stay as they are."""
        return self.request("PUT", f"/v1/participants/{code}/profile", json=limits).json()

    # ---- tests

    def preview(self, participant: str, **more: Any) -> dict[str, Any]:
        """Duration, dose and pulse widths of a test. Nothing is played. `more` as in `start_test`."""
        return self.post("/v1/preview", json={"participant": participant, **more})

    def start_test(self, participant: str, **more: Any) -> SessionTest:
        """Start a test, the pre-session test by default. `more`: `kind`, `segments` or `protocol`, `joins`, limits.

        With `kind="adaptive"` it stops itself: `target`, `max_duration_s`, `max_torque_time_nm_s`, `anyway`. What it
        can reach is then asked for before, in a request of its own.
        """
        if more.get("kind") == "adaptive":  # a start must be played at once or not at all, and this may take long
            self.post("/v1/preview", json={"participant": participant, **more}, timeout=OUTLOOK_S)
        return self.post("/v1/tests", json={"participant": participant, **more})

    def test(self, test_id: str) -> SessionTest:
        """A test as it is now."""
        return self.get(f"/v1/tests/{test_id}")

    def tests(self, participant: str) -> list[SessionTest]:
        """The tests of a participant, newest first."""
        return self.get(f"/v1/participants/{participant}/tests")

    def follow(self, test_id: str) -> Iterator[SessionTest]:
        """A test ten times a second until it is done, whatever its end."""
        while not (test := self.test(test_id))["done"]:
            yield test
            time.sleep(POLL_S)
        yield test

    def live(self, test_id: str) -> Iterator[dict[str, Any]]:
        """Live signals of a test until its end: messages of `type` "history", "live", "state" and "test"."""
        return self.messages(f"/v1/tests/{test_id}/live")

    def run_test(
        self, participant: str, watch: Callable[[SessionTest], object] = lambda _: None, **more: Any
    ) -> SessionTest:
        """Start a test and follow it to its end.

        Parameters
        ----------
        participant : str
            Code.
        watch : callable
            Called with the test ten times a second.
        **more
            As in `start_test`.

        Raises
        ------
        NotCompleted
            The test was stopped, or failed.
        """
        test = self.start_test(participant, **more)
        for state in self.follow(test["id"]):
            watch(test := state)
        if test["state"] != "completed":
            reason = test["reason"] or "no reason was given"
            raise NotCompleted("", f"the test ended as {test['state']}", reason, document=test)
        return test

    def set_ran_by(self, test_id: str, name: str | None) -> SessionTest:
        """Say who ran a test at the rig; None: who asked for it."""
        return self.request("PUT", f"/v1/tests/{test_id}/ran-by", json={"ran_by": name}).json()

    def enough(self, test_id: str) -> dict[str, Any]:
        """End a running adaptive test well, at the next pulse; its recording is identified like any other."""
        return self.post(f"/v1/tests/{test_id}/enough")

    def keep_plain(self, test_id: str) -> SessionTest:
        """End the fit of last session's structure after a test: the plain model is offered. Refused when none runs."""
        return self.post(f"/v1/tests/{test_id}/keep-plain")

    # ---- recordings

    def recording(self, recording_id: str) -> bytes:
        """The raw recording (HDF5), as it was sealed."""
        return self.request("GET", f"/v1/recordings/{recording_id}").content

    def recording_csv(self, recording_id: str) -> bytes:
        """The recording as CSV."""
        return self.request("GET", f"/v1/recordings/{recording_id}/csv").content

    def upload(self, participant: str, data: bytes | Path) -> dict[str, Any]:
        """Send a recording of another tool (CSV or HDF5). Returns `recording_id`, its new `model`, and `warnings`."""
        content = data if isinstance(data, bytes) else data.read_bytes()
        return self.post(f"/v1/participants/{participant}/recordings", content=content)
