"""What the service answers. Each document is a dict; a newer service may send more keys than are named here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

if TYPE_CHECKING:
    from stimrig.identify import Model


class Participant(TypedDict):
    """A participant: a code and limits."""

    code: str
    profile: dict[str, Any]
    created_utc: str
    created_by: str
    side: Literal["left", "right"] | None
    muscle: str | None
    placement: str | None
    archived_utc: str | None


class Note(TypedDict):
    """A note on a session, or at a time in a test."""

    id: str
    participant: str
    test_id: Annotated[str | None, "null: on the participant's session, not on a test"]
    at_s: Annotated[float | None, "time in the test, from its start, s; null: on the whole of it"]
    kind: str
    text: str
    by: str
    at_utc: str
    struck_by: Annotated[str | None, "who marked it as wrong; null: it stands"]
    struck_utc: str | None


class Version(TypedDict):
    """One model version: its errors, its verdict, and where it comes from."""

    id: str
    participant: str
    recording_id: str
    parent_id: Annotated[str | None, "the version it was made from"]
    added_effect: Annotated[str | None, "what it holds more than that one"]
    carried_from_id: str | None
    carried: dict[str, Any] | None
    method: str
    effects: list[str]
    without_evidence: Annotated[list[str], "those of them that a person added without evidence"]
    fit_percent: float | None
    ceiling_percent: Annotated[float | None, "what the noise allows, %"]
    held_out_fit_percent: Annotated[float | None, "null: nothing is held out, or the torque is level there"]
    rms_nm: float | None
    held_out_rms_nm: float | None
    noise_sd_nm: float | None
    figures: dict[str, dict[str, Any]]
    verdict: Literal["usable", "usable with care", "not usable", "unknown"]
    words: Annotated[str, "the verdict in one sentence"]
    reasons: Annotated[list[str], "what speaks against the model, worst first"]
    decision: Literal["approved", "rejected"] | None
    undone: Annotated[bool, "the decision is an undo"]
    tracking: dict[str, float] | None
    served: Annotated[bool, "the controller gets this one"]
    created_utc: str


class Trend(TypedDict):
    """A participant's sessions, oldest first, and what changed from the last approved one to the newest.

    Each session has `at_utc`, `model_id`, `approved`, `notes`, and `figures` with `value`, `sd`, `uncertainty` and
    `unit`. `changes` is None where there is nothing to compare with.
    """

    participant: str
    sessions: list[dict[str, Any]]
    changes: dict[str, Any] | None


class Tracking(TypedDict):
    """What was tracked since the approval that holds.

    Each of `trials` has `number`, `test_id`, `outcome`, `reason`, `error_percent`, and `now` and `coming` with `gain`,
    `threshold_shift_us` and `time_scale`, each `value`, `low` and `high`; None where it was not followed.
    """

    participant: str
    approved_model_id: str
    approved_utc: str
    limits: dict[str, float] | None
    threshold_us: Annotated[float | None, "of the approved curve, µs: what the limit of the threshold is of"]
    served_utc: Annotated[str | None, "since when that is known which is served"]
    served_trial: Annotated[int | None, "the trial it was tracked to; 0: the approved model"]
    etag: Annotated[str | None, "of what is served with `?tracked=true`"]
    ask: Annotated[str | None, "why a new test is needed now, in a sentence"]
    trials: list[dict[str, Any]]


class SessionTest(TypedDict):
    """A test: how far it is; when `done`, its recording, its model and its summary.

    `recording_id` and `recording_url` are text once the recording is sealed, `model_id` and `model_url` once a model is
    identified; None before. `adaptive`: of a test that stops itself, what is known by now, and why it ended.
    """

    id: str
    participant: str
    kind: str
    state: Literal[
        "requested", "running", "sealing", "identifying", "completed", "refused", "stopped", "fault", "failed"
    ]
    done: Annotated[bool, "true in every final state"]
    reason: Annotated[str, "why it ended other than completed"]
    segment: Annotated[str | None, "what is played now"]
    elapsed_s: float
    duration_s: float
    time_left_s: float
    progress: Annotated[float, "share that is done, 0 to 1"]
    identification: dict[str, Any] | None
    requested_by: str
    ran_by: Annotated[str, "who ran it at the rig"]
    side: Annotated[Literal["left", "right"] | None, "of the body, when it was begun; null: nobody has said"]
    muscle: Annotated[str | None, "the muscle that was stimulated, as it was called when the test was begun"]
    requested_utc: str
    finished_utc: str | None
    planned: dict[str, Any]
    recording_id: Any
    recording_url: Any
    joins: Annotated[str | None, "the model whose recording this one is joined to"]
    model_id: Any
    model_url: Any
    summary: dict[str, Any]
    adaptive: dict[str, Any] | None
    joint: dict[str, Any] | None
    fit: Version | None


class Job(TypedDict):
    """Long work in the service: how far it is, how long it will take, and the address of its result."""

    id: str
    kind: str
    model_id: Annotated[str | None, "of which it is; null of `fit-recordings`"]
    participant: Annotated[str | None, "of `fit-recordings`"]
    state: Literal["running", "completed", "failed", "cancelled"]
    done: bool
    progress: float
    text: str
    elapsed_s: float
    time_left_s: float | None
    result_url: str | None
    problem: dict[str, Any] | None


@dataclass(frozen=True)
class ApprovedModel:
    """The approved model of a participant, as a controller fetches it.

    Parameters
    ----------
    document : dict
        MODEL.json.
    etag : str
        Its version. With it the service answers 304 while nothing has changed.
    changed : bool
        False if this fetch was answered with 304.
    """

    document: dict[str, Any]
    etag: str
    changed: bool = True

    def model(self) -> Model:
        """The model itself, to predict with."""
        from stimrig.identify import Model  # here: a controller that reads the document alone needs no numpy

        return Model.from_dict(self.document)
