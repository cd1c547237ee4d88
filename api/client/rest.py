"""The REST client: the rig, participants, tests, recordings, models."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from stimrig.api.client.connection import Connection
from stimrig.api.client.errors import NotCompleted, NotFound, ServiceError, refused
from stimrig.api.web.responses import models
from stimrig.api.web.responses.base import Document
from stimrig.api.web.responses.models import JobOut, VersionOut
from stimrig.api.web.responses.people import ParticipantOut
from stimrig.api.web.responses.rig import HealthOut, PreviewOut, RigOut, StoppedOut, TestOut

if TYPE_CHECKING:
    from stimrig.identify import Model

POLL_S = 0.1
Progress = Callable[[float, str], None]
QUIET: Progress = lambda *_: None  # noqa: E731
OUTLOOK_S = 300.0
"""So long a busy service may take to say what an adaptive test can reach; usually it takes a few seconds."""
D = TypeVar("D", bound=Document)


@dataclass(frozen=True)
class ApprovedModel:
    """The approved model of a participant, as a controller fetches it: the `document` MODEL.json and its `etag`.

    `changed` is False if the service has answered with 304: nothing has changed since the one that was known.
    """

    document: dict[str, Any]
    etag: str
    changed: bool = True

    def model(self) -> Model:
        """The model itself, to predict with."""
        from stimrig.identify import Model  # here: a controller that reads the document alone needs no numpy

        return Model.from_dict(self.document)


class Client(Connection):
    """Client of a running service. Each method sends one request unless stated otherwise; nothing is retried.

    An answer's fields are read as `test.state` or `test["state"]`; `to_dict()` gives it as it was sent. `request`,
    `get` and `post` reach every other route of docs/api.md. Each method raises ServiceError: `Unreachable` without an
    answer, else a subclass of `Refused` with title, detail and status.

    Examples
    --------
    >>> with Client("http://127.0.0.1:8000", token) as client:  # doctest: +SKIP
    ...     client.make_participant("P017")
    ...     test = client.run_test("P017")
    ...     client.approve(test.model_id, "good fit")
    """

    def _request_as(self, kind: type[D], method: str, path: str, **more: Any) -> D:
        return kind.read(self.request(method, f"/v1{path}", **more).json())

    def health(self) -> HealthOut:
        """Return whether the service and its rig answer; needs no token."""
        return HealthOut.read(self.get("/health"))

    def rig(self) -> RigOut:
        """State, devices, newest torque and its age."""
        return self._request_as(RigOut, "GET", "/rig")

    def stop(self, reason: str = "") -> StoppedOut:
        """Stop stimulation. Returns only if the rig confirms that stimulation has stopped.

        `reason` stands in the audit trail.
        """
        return self._request_as(StoppedOut, "POST", "/stop", json={"reason": reason} if reason else {})

    def issue_token(self, name: str, scopes: Sequence[str]) -> str:
        """A new token for a program of this name, with scopes as "read-model"; only an administrator may do this."""
        return self.post("/v1/tokens", json={"name": name, "scopes": list(scopes)})["token"]

    def participant(self, code: str) -> ParticipantOut:
        """One participant with its limits."""
        return self._request_as(ParticipantOut, "GET", f"/participants/{code}")

    def make_participant(
        self, code: str, profile: dict[str, float] | None = None, **site: str | None
    ) -> ParticipantOut:
        """Make a participant: a code of letters, digits, - and _, never a name.

        `profile`: current_ma, max_pulse_width_us, max_torque_nm. `site`: `side` ("left" or "right"), `muscle` and
        `placement` of the electrodes, to which models belong.
        """
        body = {"code": code, **({"profile": profile} if profile else {}), **site}
        return self._request_as(ParticipantOut, "POST", "/participants", json=body)

    def ensure_participant(self, code: str) -> ParticipantOut:
        """The participant; makes it if there is none (two requests)."""
        try:
            return self.participant(code)
        except NotFound:
            return self.make_participant(code)

    def preview(self, participant: str, **more: Any) -> PreviewOut:
        """Duration, dose and pulse widths of a test. Nothing is played. `more` as in `start_test`."""
        wait = {"timeout": OUTLOOK_S} if more.get("kind") == "adaptive" else {}
        return self._request_as(PreviewOut, "POST", "/preview", json={"participant": participant, **more}, **wait)

    def start_test(self, participant: str, **more: Any) -> TestOut:
        """Start a test, the pre-session test by default. `more`: `kind`, `segments` or `protocol`, `joins`, limits.

        With `kind="adaptive"` it stops itself: `target`, `max_duration_s`, `max_torque_time_nm_s`, `anyway`.
        What it can reach is then asked for before, in a request of its own.
        """
        if more.get("kind") == "adaptive":  # a start must be played at once or not at all, and this may take long
            self.preview(participant, **more)
        return self._request_as(TestOut, "POST", "/tests", json={"participant": participant, **more})

    def test(self, test_id: str) -> TestOut:
        """A test as it is now."""
        return self._request_as(TestOut, "GET", f"/tests/{test_id}")

    def follow(self, test_id: str) -> Iterator[TestOut]:
        """A test ten times a second until it is done, whatever its end."""
        while not (test := self.test(test_id)).done:
            yield test
            time.sleep(POLL_S)
        yield test

    def live(self, test_id: str) -> Iterator[dict[str, Any]]:
        """Live signals of a test until its end: messages of `type` "history", "live", "state" and "test"."""
        return self.messages(f"/v1/tests/{test_id}/live")

    def run_test(self, participant: str, watch: Callable[[TestOut], object] = bool, **more: Any) -> TestOut:
        """Start a test, as `start_test`, and follow it to its end; `watch` is called with the test ten times a second.

        Raises NotCompleted: the test was stopped, or failed.
        """
        test = self.start_test(participant, **more)
        for now in self.follow(test.id):
            watch(test := now)
        if test.state != "completed":
            reason = test.reason or "no reason was given"
            raise NotCompleted("", f"the test ended as {test.state}", reason, document=test.to_dict())
        return test

    def enough(self, test_id: str) -> dict[str, Any]:
        """End a running adaptive test well, at the next pulse; its recording is identified like any other."""
        return self.post(f"/v1/tests/{test_id}/enough")

    def recording(self, recording_id: str) -> bytes:
        """The raw recording (HDF5), as it was sealed."""
        return self.request("GET", f"/v1/recordings/{recording_id}").content

    def recording_csv(self, recording_id: str) -> bytes:
        """The recording as CSV."""
        return self.request("GET", f"/v1/recordings/{recording_id}/csv").content

    def versions(self, participant: str) -> list[VersionOut]:
        """Model versions of a participant, newest first."""
        return [VersionOut.read(row) for row in self.get(f"/v1/participants/{participant}/models")]

    def version(self, model_id: str) -> VersionOut:
        """One model version."""
        return self._request_as(VersionOut, "GET", f"/models/{model_id}")

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
        more = {
            "headers": {"If-None-Match": known.etag} if known else {},
            "params": {"tracked": True} if tracked else {},
        }
        answer = self.request("GET", f"/v1/participants/{participant}/model", **more)
        if known and answer.status_code == 304:
            return ApprovedModel(known.document, known.etag, changed=False)
        return ApprovedModel(answer.json(), answer.headers["etag"])

    def tracking(self, participant: str) -> models.TrackingOut:
        """The trials since the approval that holds: how gain, threshold and time scale moved, and whether to ask."""
        return self._request_as(models.TrackingOut, "GET", f"/participants/{participant}/tracking")

    def approve(self, model_id: str, reason: str = "", tracking: dict[str, float] | None = None) -> VersionOut:
        """Let the controller have this version; a `reason` is needed for a model that is not usable.

        `tracking`: `gain_percent`, `threshold_percent`, `time_scale_percent`, how far the tracked model may move, each
        0 (not tracked) to 60; 20 where it is left out.
        """
        body = {"reason": reason} if tracking is None else {"reason": reason, "tracking": tracking}
        return self._request_as(VersionOut, "POST", f"/models/{model_id}/approve", json=body)

    def reject(self, model_id: str, reason: str = "") -> VersionOut:
        """Keep this version from the controller."""
        return self._request_as(VersionOut, "POST", f"/models/{model_id}/reject", json={"reason": reason})

    def predict(self, model_id: str, pulse_width_us: Sequence[float], **more: Any) -> list[float]:
        """Mean torque in the period of each pulse, N·m, with all effects of the model. Nothing is played.

        `more`: `pulse_rate_hz`, by default the model's; `angle_rad` of the joint in each period, rad, which a model
        that depends on it needs.
        """
        body = {"pulse_width_us": list(pulse_width_us), **more}
        return self.post(f"/v1/models/{model_id}/prediction", json=body)["torque_nm"]

    def widths(self, model_id: str, reference: Sequence[float], **more: Any) -> models.InversionOut:
        """The pulse widths with which the model follows a torque best, and what of it is out of reach.

        `reference`: torque above rest, N·m, one for each pulse, or one for each of the rising times `time_s`. `more`:
        `time_s`, `pulse_rate_hz`, `max_pulse_width_us`, `max_rise_us`, `whole_us`. Its `segments` are for `start_test`.
        """
        body = {"reference_torque_nm": list(reference), **more}
        return self._request_as(models.InversionOut, "POST", f"/models/{model_id}/widths", json=body)

    def curves(self, model_id: str) -> models.CurvesOut:
        """Measured and predicted torque, pulse widths and step response, for drawing."""
        return self._request_as(models.CurvesOut, "GET", f"/models/{model_id}/curves")

    def diagnosis(self, model_id: str, progress: Progress = QUIET) -> models.DiagnosisOut:
        """Diagnose what the model lacks. `progress` as in `add_effects`."""
        return self._long(models.DiagnosisOut, "GET", f"/models/{model_id}/diagnosis", progress)

    def add_effects(
        self, model_id: str, effects: Sequence[str], force: bool = False, reason: str = "", progress: Progress = QUIET
    ) -> VersionOut:
        """Fit a new version with more effects; the version they are added to stays as it is.

        `force` adds them even if the recording does not ask for them, and needs a `reason`; else Conflict is raised.
        `progress` is called with a share of 0 to 1 and a line of text; what it raises cancels the work.
        """
        body = {"effects": list(effects), "force": force, "reason": reason}
        return self._long(VersionOut, "POST", f"/models/{model_id}/effects", progress, json=body)

    def improve(self, model_id: str, progress: Progress = QUIET) -> VersionOut:
        """Add effects one by one while the evidence asks for them; returns the last version. `progress` as above."""
        return self._long(VersionOut, "POST", f"/models/{model_id}/improve", progress)

    def _long(self, kind: type[D], method: str, path: str, progress: Progress, **more: Any) -> D:
        answer = self.request(method, f"/v1{path}", params={"wait": False}, **more)
        if answer.status_code != 202:
            return kind.read(answer.json())
        job = JobOut.read(answer.json())
        try:
            while not job.done:
                progress(job.progress, job.text)
                time.sleep(POLL_S)
                job = self._request_as(JobOut, "GET", f"/jobs/{job.id}")
            progress(1.0, "done")
        except BaseException:
            with contextlib.suppress(ServiceError):  # the first error is the one to tell
                self.request("DELETE", f"/v1/jobs/{job.id}")
            raise
        if job.result_url is not None:
            return kind.read(self.get(job.result_url))
        ended = job.to_dict()
        if job.state == "cancelled" or ended["problem"] is None:
            raise NotCompleted("", f"the job ended as {job.state}", document=ended)
        raise refused(f"GET /v1/jobs/{job.id}", ended["problem"]["status"], ended["problem"])
