"""What repeats stands on the page, in the reports and on the command line."""

from __future__ import annotations

import numpy as np

from stimrig import identify
from stimrig.api.jobs.curves import curves
from stimrig.api.web.pages.report_file import comparison_html
from stimrig.identify.json_text import json_value
from tests.harness.muscle import Patient
from tests.harness.patients import make_record, ramp

REST = np.zeros(120)


def test_a_report_and_the_command_line_have_it():
    widths = np.concatenate([REST, ramp(6), REST, ramp(6), REST])
    names = ["rest"] * 120 + ["ramp"] * 240 + ["rest"] * 120 + ["validate"] * 240 + ["rest"] * 120
    record, _ = make_record(
        Patient(time_constant_s=0.12), np.random.default_rng(1), rate_hz=100, pulses=(widths, names)
    )
    model = identify.fit(record)
    document = model.to_dict()
    page = comparison_html(document, json_value(curves(model, record)), "a record")
    assert "What repeats" in page
    assert "Between 2 repeats of the same pulses the torque differs by" in page
    assert "Between 2 repeats" in str(model)
