"""A person reads an effect's title; its id stays in titles, links and REST."""

from __future__ import annotations

from stimrig.api.effect_words import library, parameter_words
from stimrig.api.models import stored_model
from stimrig.identify import effects

PLAIN = {
    "sample_rate_hz": 40.0,
    "linear": {"b": [0.0, 0.002], "a": [1.0, -1.93, 0.934], "delay_samples": 0},
    "uncertainty": {"figures": {}},
}


def test_what_an_effect_says_of_itself_is_read_from_its_file_as_it_is_loaded() -> None:
    """Its title, whether it is of the muscle, and each form's main parameter with a name: in its own file alone."""
    for effect, known in effects.registry().items():
        said = {"muscle": True, "main": {}} | library()[effect]
        assert (said["name"], said["muscle"], said["main"]) == (known.name, known.muscle, known.main)
        assert all(parameter_words(parameter) == words for parameter, words in known.main.items()), effect
        for form in known.forms:
            held = {"id": effect, "parameters": {one.name: {"value": 1.0, "sd": None} for one in form.parameters}}
            (figure,) = [name for name in stored_model.muscle_figures(PLAIN | {"effects": [held]}) if "." in name]
            assert figure.partition(".")[2] in known.main, figure
    assert set(library()) == set(effects.registry())
