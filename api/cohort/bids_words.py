"""What the sidecars of a BIDS-style export say of each column, and its README."""

from __future__ import annotations

from typing import Any

Words = dict[str, dict[str, Any]]

PHYSIO: Words = {
    "time_s": {
        "Description": "time of the sample, test's clock, where the even rate does not give it",
        "Units": "s",
    },
    "torque_nm": {"Description": "elbow torque, zero offset not removed; n/a: the sample was lost", "Units": "N.m"},
    "angle_rad": {"Description": "joint angle", "Units": "rad"},
    "velocity_rad_s": {"Description": "angular velocity of the joint", "Units": "rad/s"},
    "sync": {"Description": "stimulator's sync line as the load cell saw it, 0 or 1"},
}
STIM: Words = {
    "pulse_width_us": {
        "Description": "width of a phase of the pulse in force, held between pulses; 0: none; n/a: outside of every "
        "segment, or the sample was lost",
        "Units": "us",
    },
    "late_s": {"Description": "by how much later than its even slot the pulse in force was felt", "Units": "s"},
    "doubted": {"Description": "1: it is not known what was felt"},
}
EVENTS: Words = {
    "onset": {"Description": "begin of the segment; when the pulse's command had been written to the line (of one that "
              "was not sent: when it was due). Zero is the start of the first segment, as in the continuous recordings",
              "Units": "s"},
    "duration": {"Description": "of a segment; 0 for a pulse", "Units": "s"},
    "trial_type": {
        "Description": "what the row is",
        "Levels": {"segment": "a part of the test", "pulse": "a pulse that was sent",
                   "pulse_not_sent": "a planned pulse that was dropped or refused"},
    },
    "segment": {"Description": "name of the segment; rows of `validate` are held out from fits"},
    "pulse_index": {"Description": "index of the pulse in the test, from 0"},
    "pulse_width": {"Description": "width of a phase as sent", "Units": "us"},
    "planned_pulse_width": {"Description": "width of a phase as planned", "Units": "us"},
    "current": {"Description": "current as sent", "Units": "mA"},
    "planned_onset": {"Description": "when the pulse was due", "Units": "s"},
    "acknowledged": {"Description": "when the stimulator's acknowledgement was read; n/a: none came", "Units": "s"},
    "status": {"Description": "what became of the pulse: acknowledged, dropped, refused, unacknowledged, device error"},
}  # fmt: skip
SCANS: Words = {
    "filename": {"Description": "the continuous recording of torque; its stim and events files are called alike"},
    "acq_time": {"Description": "when the recording was made (UTC); moved or n/a where days are hidden"},
    "kind": {"Description": "kind of test"},
    "outcome": {"Description": "how the test ended: completed, stopped, fault"},
    "duration_s": {"Description": "from the first sample in a segment to the last", "Units": "s"},
    "sample_rate_hz": {"Description": "samples a second", "Units": "Hz"},
    "record_id": {"Description": "id of the recording"},
    "sha256": {"Description": "SHA-256 of the file that was exported"},
}
PARTICIPANTS: Words = {
    "participant_id": {"Description": "sub- and the label: the letters and digits of the code"},
    "code": {"Description": "the participant's code as it was given"},
    "sessions": {"Description": "number of sessions (days)"},
    "recordings": {"Description": "number of recordings"},
}
DESCRIPTION: dict[str, Any] = {
    "Name": "Electrically stimulated muscle: torque and pulses",
    "BIDSVersion": "1.9.0",
    "DatasetType": "raw",
}
README = """Torque at the elbow while a muscle is stimulated electrically, exported by stimrig.

Each recording is one test: `sub-<label>/ses-<day>/beh/sub-…_ses-…_task-<kind>_acq-<recording>_…`

- `…_physio.tsv.gz`: torque at the load cell's own rate (no header; columns, rate and start are in the JSON beside it);
- `…_stim.tsv.gz`: the pulse width in force at each of these samples;
- `…_events.tsv`: each pulse and each segment of the test;
- `…_scans.tsv` of a session: when each recording was made, and how it ended.

Row k of a continuous recording was measured at StartTime + k / SamplingFrequency, on the clock of the events. `acq-` is
the beginning of the SHA-256 of the exported file. A session is a day (UTC). `participants.tsv` says which code a label
stands for. What could not be exported is in `errors.csv`.
"""
