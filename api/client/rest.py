"""The REST client: the rig, participants, tests, recordings, models."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from stimrig.api.client.connection import Connection
from stimrig.api.client.documents import ApprovedModel, Job, Note, Participant, SessionTest, Tracking, Trend, Version
from stimrig.api.client.errors import NotCompleted, NotFound, ServiceError, refused

POLL_S = 0.1
Progress = Callable[[float, str], None]
OUTLOOK_S = 300.0
"""So long a busy service may take to say what an adaptive test can reach; usually it takes a few seconds."""
UPLOAD_S = 3600.0
"""So long an upload's answer may take: it waits for the fit. The service ends one that takes too long, and says so."""


class Client(Connection):
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
        """Stop stimulation. Returns only if the rig confirms that stimulation has stopped.

        `reason` stands in the audit trail.
        """
        return self.post("/v1/stop", json={"reason": reason} if reason else {})

    def lock(self) -> None:
        """Lock the session of a person at once. A token has none to lock: `Conflict`."""
        self.request("POST", "/v1/sessions/lock")

    def effects(self) -> list[dict[str, Any]]:
        """The library of effects of the service."""
        return self.get("/v1/effects")["effects"]

    def issue_token(self, name: str, scopes: Sequence[str]) -> str:
        """A new token for a program of this name, with scopes as "read-model"; only an administrator may do this."""
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
        """Make a participant: a code of letters, digits, - and _, never a name.

        `profile`: current_ma, max_pulse_width_us, max_torque_nm. `side` ("left" or "right"), `muscle` and `placement`
        of the electrodes are the site, to which models belong.
        """
        more = {"profile": profile, "side": side, "muscle": muscle, "placement": placement}
        return self.post(
            "/v1/participants", json={"code": code, **{key: value for key, value in more.items() if value}}
        )

    def set_muscle(
        self, code: str, side: str | None, muscle: str | None, placement: str | None = None
    ) -> Participant:  # fmt: skip
        """Say which site is stimulated, as in `make_participant`; refused where a calibration would be lost by it."""
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
        """Change the limits that are named, as `current_ma=20.0`; the others stay as they are."""
        return self.request("PUT", f"/v1/participants/{code}/profile", json=limits).json()

    # ---- tests

    def preview(self, participant: str, **more: Any) -> dict[str, Any]:
        """Duration, dose and pulse widths of a test. Nothing is played. `more` as in `start_test`."""
        return self.post("/v1/preview", json={"participant": participant, **more})

    def start_test(self, participant: str, **more: Any) -> SessionTest:
        """Start a test, the pre-session test by default. `more`: `kind`, `segments` or `protocol`, `joins`, limits.

        With `kind="adaptive"` it stops itself: `target`, `max_duration_s`, `max_torque_time_nm_s`, `anyway`.
        What it can reach is then asked for before, in a request of its own.
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
        """Start a test, as `start_test`, and follow it to its end; `watch` is called with the test ten times a second.

        Raises NotCompleted: the test was stopped, or failed.
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
        return self.post(f"/v1/participants/{participant}/recordings", content=content, timeout=UPLOAD_S)

    # ---- models

    def versions(self, participant: str) -> list[Version]:
        """Model versions of a participant, newest first."""
        return self.get(f"/v1/participants/{participant}/models")

    def trend(self, participant: str) -> Trend:
        """Sessions of a participant, oldest first: figures with their uncertainty, and what changed."""
        return self.get(f"/v1/participants/{participant}/trend")

    def trend_csv(self, participant: str) -> bytes:
        """The same as a CSV file."""
        return self.request("GET", f"/v1/participants/{participant}/trend.csv").content

    def version(self, model_id: str) -> Version:
        """One model version."""
        return self.get(f"/v1/models/{model_id}")

    def model_file(self, model_id: str) -> dict[str, Any]:
        """MODEL.json of a version, as `stimrig.Model.from_dict` takes it."""
        return self.get(f"/v1/models/{model_id}/file")

    def approved_model(
        self, participant: str, known: ApprovedModel | None = None, tracked: bool = False
    ) -> ApprovedModel:
        """The approved model now. With the one that is `known`, the service sends it only if it has changed.

        With `tracked` it is as it was tracked to the last trial, within the limits of the approval; its key `tracking`
        says how, and in `ask` why a new test is needed, if one is.

        Raises NotFound: no model is approved today.
        """
        headers = {"If-None-Match": known.etag} if known else {}
        params = {"tracked": True} if tracked else {}
        answer = self.request("GET", f"/v1/participants/{participant}/model", headers=headers, params=params)
        if known and answer.status_code == 304:
            return ApprovedModel(known.document, known.etag, changed=False)
        return ApprovedModel(answer.json(), answer.headers["etag"])

    def tracking(self, participant: str) -> Tracking:
        """The trials since the approval that holds: how gain, threshold and time scale moved, and whether to ask.

        Raises NotFound: no model is approved today.
        """
        return self.get(f"/v1/participants/{participant}/tracking")

    def approve(self, model_id: str, reason: str = "", tracking: dict[str, float] | None = None) -> Version:
        """Let the controller have this version; a `reason` is needed for a model that is not usable.

        `tracking`: `gain_percent`, `threshold_percent`, `time_scale_percent`, how far the tracked model may move, each
        0 (not tracked) to 60; 20 where it is left out.
        """
        body = {"reason": reason, **({} if tracking is None else {"tracking": tracking})}
        return self.post(f"/v1/models/{model_id}/approve", json=body)

    def reject(self, model_id: str, reason: str = "") -> Version:
        """Keep this version from the controller."""
        return self.post(f"/v1/models/{model_id}/reject", json={"reason": reason})

    def undo(self, model_id: str, reason: str = "") -> Version:
        """Go back to the version this one was made from; returns that one."""
        return self.post(f"/v1/models/{model_id}/undo", json={"reason": reason})

    def predict(
        self,
        model_id: str,
        pulse_width_us: Sequence[float],
        pulse_rate_hz: float | None = None,
        angle_rad: Sequence[float] | None = None,
    ) -> list[float]:
        """Mean torque in the period of each pulse, N·m, with all effects of the model. Nothing is played.

        `pulse_rate_hz`: by default the model's. `angle_rad`: of the joint in each period, rad; a model that depends on
        it needs it.
        """
        body: dict[str, Any] = {"pulse_width_us": list(pulse_width_us), "pulse_rate_hz": pulse_rate_hz}
        if angle_rad is not None:
            body["angle_rad"] = list(angle_rad)
        return self.post(f"/v1/models/{model_id}/prediction", json=body)["torque_nm"]

    def widths(
        self, model_id: str, reference: Sequence[float], time_s: Sequence[float] | None = None, **more: Any
    ) -> dict[str, Any]:
        """The pulse widths with which the model follows a torque best, and what of it is out of reach.

        `reference`: torque above rest, N·m, one for each pulse, or one for each of the rising times `time_s`. `more`:
        `pulse_rate_hz`, `max_pulse_width_us`, `max_rise_us`, `whole_us`. Returns `pulse_width_us`,
        `predicted_torque_nm`, `unreachable`, `fit_percent`, and `segments` for `start_test`.
        """
        body = {"reference_torque_nm": list(reference), "time_s": None if time_s is None else list(time_s), **more}
        return self.post(f"/v1/models/{model_id}/widths", json=body)

    def curves(self, model_id: str) -> dict[str, Any]:
        """Measured and predicted torque, pulse widths and step response, for drawing."""
        return self.get(f"/v1/models/{model_id}/curves")

    def comparison(self, model_id: str, recording_id: str | None = None) -> dict[str, Any]:
        """The model against its own recording, or against another one."""
        return self.get(f"/v1/models/{model_id}/comparison", params={"recording": recording_id} if recording_id else {})

    # ---- long work: a job that is followed, however long it takes, and cancelled where it is interrupted

    def diagnosis(self, model_id: str, progress: Progress | None = None) -> dict[str, Any]:
        """What is missing in the model. `progress` as in `add_effects`."""
        return self._long("GET", f"/v1/models/{model_id}/diagnosis", progress)

    def add_effects(
        self,
        model_id: str,
        effects: Sequence[str],
        force: bool = False,
        reason: str = "",
        progress: Progress | None = None,
    ) -> Version:
        """Fit a new version with more effects; the version they are added to stays as it is.

        `force` adds them even if the recording does not ask for them, and needs a `reason`. `progress` is called with a
        share of 0 to 1 and a line of text; what it raises cancels the work.

        Raises Conflict: the recording does not ask for an effect, or the model holds it already. Raises NotCompleted:
        somebody cancelled the job.
        """
        body = {"effects": list(effects), "force": force, "reason": reason}
        return self._long("POST", f"/v1/models/{model_id}/effects", progress, json=body)

    def improve(self, model_id: str, progress: Progress | None = None) -> Version:
        """Add effects one by one while the evidence asks for them; returns the last version. `progress` as above."""
        return self._long("POST", f"/v1/models/{model_id}/improve", progress)

    def job(self, job_id: str) -> Job:
        """Long work as it is now."""
        return self.get(f"/v1/jobs/{job_id}")

    def cancel(self, job_id: str) -> Job:
        """Cancel long work. What is done already stays done."""
        return self.request("DELETE", f"/v1/jobs/{job_id}").json()

    def _long(self, method: str, path: str, progress: Progress | None, **more: Any) -> Any:
        answer = self.request(method, path, params={"wait": False}, **more)
        found = answer.json()
        return self._result(found, progress or (lambda *_: None)) if answer.status_code == 202 else found

    def _result(self, job: Job, progress: Progress) -> Any:
        try:
            while not job["done"]:
                progress(job["progress"], job["text"])
                time.sleep(POLL_S)
                job = self.job(job["id"])
            progress(1.0, "done")
        except BaseException:
            with contextlib.suppress(ServiceError):  # the first error is the one to tell
                self.cancel(job["id"])
            raise
        if job["result_url"] is not None:
            return self.get(job["result_url"])
        problem = job["problem"]
        if job["state"] == "cancelled" or problem is None:
            raise NotCompleted("", f"the job ended as {job['state']}", document=job)
        raise refused(f"GET /v1/jobs/{job['id']}", problem["status"], problem)
