"""Base of all responses, and the parts that several share."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, WithJsonSchema

from stimrig.api.schemas import component_name
from stimrig.api.schemas.shared import SETTINGS
from stimrig.rig.messages import StopEvidence


class Document(BaseModel):
    """Base of all answers; newer versions may add fields.

    A field is read as `answer.state` or as `answer["state"]`.
    """

    model_config = ConfigDict(extra="allow")

    @classmethod
    def read(cls, answer: dict[str, Any]) -> Self:
        """Make it of a service's answer; one that a newer service has changed is kept as it came."""
        try:
            return cls.model_validate(answer)
        except ValidationError:
            return cls.model_construct(**answer)

    def keys(self) -> list[str]:
        """Names of all fields."""
        return [*self._fields()]

    def get(self, name: str, default: Any = None) -> Any:
        """Value of a field; `default` where there is none."""
        return self._fields().get(name, default)

    def __getitem__(self, name: str) -> Any:
        return self._fields()[name]

    def __contains__(self, name: str) -> bool:
        return name in self._fields()

    def _fields(self) -> dict[str, Any]:
        return {**self.__dict__, **(self.model_extra or {})}

    def to_dict(self) -> dict[str, Any]:
        """As it was sent, for `json.dumps`."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True, warnings=False)


class FieldProblem(Document):
    """One field that does not hold."""

    field: str
    detail: str
    got: str = Field("", description="what was sent, shortened")


class Holder(Document):
    """The test that holds the rig."""

    test_id: str
    participant: str
    by: str


class EntryOut(Document):
    """Entry of the audit trail."""

    at_utc: str
    who: str = Field(description="empty: the rig itself")
    action: str
    subject: str
    detail: dict[str, JsonValue] = Field(description="what belongs to this action: reasons, limits, ids")


class ChangeOut(Document):
    """A change of what was decided on, since the version that was sent."""

    who: str = Field(description="empty: the rig itself")
    at_utc: str
    action: str
    subject: str
    old: str = Field(description="what it was, in words; empty: nothing")
    new: str = Field(description="what it is now")


class ReachOut(Document):
    """Assessment of an adaptive test's target before the first pulse."""

    reachable: bool
    curve_percent: float | None = Field(description="half-width of the curve's band at the end, %; null: none at all")
    step_percent: float | None = Field(description="of the step response, %")
    seconds: float = Field(description="what the test would take, s")
    torque_time_nm_s: float = Field(description="what it would cost, N·m·s")
    words: str
    known: bool = Field(False, description="whether a model of an earlier session helps")


class ConfirmRow(Document):
    """Change of one value, from the old to the new one."""

    what: str
    now: str
    before: str = Field(description="empty: nothing was there")


class ConfirmOut(Document):
    """A question that is answered by sending the same again with `?confirm=TOKEN`."""

    title: str
    button: str
    rows: list[ConfirmRow]
    warnings: list[str]
    token: str


class Problem(Document):
    """Why a request failed (RFC 9457)."""

    type: str = Field(description="stable id of the problem: `/problems/…`", examples=["/problems/not-found"])
    title: str = Field(description="what is wrong, in a few words")
    status: int = Field(description="the HTTP status")
    detail: str = Field(description="what is wrong here, and what to do")
    instance: str = Field("", description="the address that was asked")
    errors: list[FieldProblem] = Field([], description="422: each field that does not hold")
    holder: Holder | None = Field(None, description="409 `rig-busy`: the test that holds the rig")
    reasons: dict[str, str] = Field({}, description="409 of effects: why each one was not added, by its id")
    place: str | None = Field(None, description="422 of a file, a model or a reference: what of it does not hold")
    fix: str | None = Field(None, description="with `place`: how to mend it")
    changes: list[ChangeOut] = Field([], description="412: each change since the version that was sent, newest last")
    confirm: ConfirmOut | None = Field(None, description="409: what deserves a second look")
    of: str | None = Field(None, description="409 `other-participant`: whose recording it is; send it as `of`")
    reach: ReachOut | None = Field(None, description="422 `out-of-reach`: what the adaptive test will probably reach")
    evidence: StopEvidence | None = Field(None, description="503 `stop-not-confirmed`: what is known of the stop")


class SegmentOut(Document):
    """A segment of a test, as `POST /v1/tests` takes it."""

    name: str
    sequence: str
    settings: Annotated[dict[str, JsonValue], WithJsonSchema(SETTINGS)] = {}


def published(name: str, description: str) -> dict[str, Any]:
    """An answer that holds to a published schema (`stimrig.api.schemas`)."""
    schema = {"$ref": f"#/components/schemas/{component_name(name)}"}
    return {"description": description, "content": {"application/json": {"schema": schema}}}


def describe_answer(model: Any, status: int = 200, description: str = "done", **more: Any) -> dict[str, Any]:
    """Settings of a route whose answer is described, and not checked or changed on its way."""
    return {"response_model": None, "responses": {status: {"model": model, "description": description, **more}}}
