"""What the service fits to a moving joint is what `identify` says a moving joint is made of."""

from __future__ import annotations

from pydantic import TypeAdapter

from api.models.together import JOINT_EFFECTS
from api.web.routes.joint import EffectId
from identify.effects import get
from identify.fitting import MOVING_JOINT


def test_the_service_names_the_effects_of_identify():
    assert JOINT_EFFECTS == MOVING_JOINT


def test_each_form_is_known_and_may_be_asked_for():
    for name in JOINT_EFFECTS:
        assert TypeAdapter(EffectId).validate_python(name) == name
        effect, _, forms = name.partition(":")
        assert [get(effect).form(form).name for form in forms.split("|")] == forms.split("|")
