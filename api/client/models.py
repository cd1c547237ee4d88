"""Models over REST: versions, approval, criticism, and the long work of adding effects."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from typing import Any

from stimrig.api.client.connection import Connection
from stimrig.api.client.documents import ApprovedModel, Job, Tracking, Trend, Version
from stimrig.api.client.errors import NotCompleted, ServiceError, refused

POLL_S = 0.1
Progress = Callable[[float, str], None]


class Models(Connection):
    """What the REST client does with models. Errors: as `Client`."""

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

        Raises
        ------
        NotFound
            No model is approved today.
        """
        headers = {"If-None-Match": known.etag} if known else {}
        params = {"tracked": True} if tracked else {}
        answer = self.request("GET", f"/v1/participants/{participant}/model", headers=headers, params=params)
        if known and answer.status_code == 304:
            return ApprovedModel(known.document, known.etag, changed=False)
        return ApprovedModel(answer.json(), answer.headers["etag"])

    def tracking(self, participant: str) -> Tracking:
        """The trials since the approval that holds: how gain, threshold and time scale moved, and whether to ask.

        Raises
        ------
        NotFound
            No model is approved today.
        """
        return self.get(f"/v1/participants/{participant}/tracking")

    def approve(self, model_id: str, reason: str = "", tracking: dict[str, float] | None = None) -> Version:
        """Let the controller have this version.

        Parameters
        ----------
        model_id : str
            The version.
        reason : str
            Why; needed for a model that is not usable.
        tracking : dict, optional
            `gain_percent`, `threshold_percent`, `time_scale_percent`: how far the tracked model may move, each 0 (not
            tracked) to 60; 20 where it is left out.
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
        pulse_rate_hz: float = 40.0,
        angle_rad: Sequence[float] | None = None,
    ) -> list[float]:
        """Mean torque in the period of each pulse, N·m, with all effects of the model. Nothing is played.

        `angle_rad`: of the joint in each period, rad; a model that depends on it needs it.
        """
        body: dict[str, Any] = {"pulse_width_us": list(pulse_width_us), "pulse_rate_hz": pulse_rate_hz}
        if angle_rad is not None:
            body["angle_rad"] = list(angle_rad)
        return self.post(f"/v1/models/{model_id}/prediction", json=body)["torque_nm"]

    def widths(
        self, model_id: str, reference: Sequence[float], time_s: Sequence[float] | None = None, **more: Any
    ) -> dict[str, Any]:
        """The pulse widths with which the model follows a torque best, and what of it is out of reach.

        Parameters
        ----------
        model_id : str
            Version.
        reference : sequence of float
            Torque above rest, N·m: one for each pulse, or one for each of `time_s`.
        time_s : sequence of float, optional
            Times, s, rising.
        **more
            `pulse_rate_hz`, `max_pulse_width_us`, `max_rise_us`, `whole_us`.

        Returns
        -------
        dict
            `pulse_width_us`, `predicted_torque_nm`, `unreachable`, `fit_percent`, and `segments` for `start_test`.
        """
        body = {"reference_torque_nm": list(reference), "time_s": None if time_s is None else list(time_s), **more}
        return self.post(f"/v1/models/{model_id}/widths", json=body)

    def curves(self, model_id: str) -> dict[str, Any]:
        """Measured and predicted torque, pulse widths and step response, for drawing."""
        return self.get(f"/v1/models/{model_id}/curves")

    def comparison(self, model_id: str, recording_id: str | None = None) -> dict[str, Any]:
        """The model against its own recording, or against another one."""
        return self.get(f"/v1/models/{model_id}/comparison", params={"recording": recording_id} if recording_id else {})

    # ---- long work: with `progress` as a job that is followed and can be cancelled

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
        """Fit a new version with more effects.

        Parameters
        ----------
        model_id : str
            Version to add to; it stays as it is.
        effects : sequence of str
            Ids of effects.
        force : bool
            Add them even if the recording does not ask for them; needs a `reason`.
        progress : callable, optional
            Called with a share of 0 to 1 and a line of text. What it raises cancels the work.

        Raises
        ------
        Conflict
            The recording does not ask for an effect, or the model holds it already.
        NotCompleted
            Somebody cancelled the job.
        """
        body = {"effects": list(effects), "force": force, "reason": reason}
        return self._long("POST", f"/v1/models/{model_id}/effects", progress, json=body)

    def improve(self, model_id: str, progress: Progress | None = None) -> Version:
        """Add effects one by one while the evidence asks for them; returns the last version. `progress` as above."""
        found = self._long("POST", f"/v1/models/{model_id}/improve", progress)
        return found["versions"][-1] if "versions" in found else found

    def job(self, job_id: str) -> Job:
        """Long work as it is now."""
        return self.get(f"/v1/jobs/{job_id}")

    def cancel(self, job_id: str) -> Job:
        """Cancel long work. What is done already stays done."""
        return self.request("DELETE", f"/v1/jobs/{job_id}").json()

    def _long(self, method: str, path: str, progress: Progress | None, **more: Any) -> Any:
        if progress is None:
            return self.request(method, path, **more).json()
        answer = self.request(method, path, params={"wait": False}, **more)
        return self._result(answer.json(), progress) if answer.status_code == 202 else answer.json()

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
