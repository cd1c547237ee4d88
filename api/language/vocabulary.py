"""Words that are stored or answered as they are, and translated where a page shows them (`|translated`).

And what may stand at a place of a sentence that is put together elsewhere (`f"No{more} effect of the library …"`).
"""

from __future__ import annotations

from stimrig.api.language.words import lazy

VOCABULARY = [
    # roles of people
    lazy("administrator"), lazy("clinician"), lazy("engineer"), lazy("researcher"), lazy("controller"),
    lazy("reader"),
    # states of a test
    lazy("requested"), lazy("running"), lazy("sealing"), lazy("identifying"), lazy("completed"), lazy("stopped"),
    lazy("fault"), lazy("failed"), lazy("refused"), lazy("cancelled"),
    # methods
    lazy("maximum-likelihood"), lazy("two-stage"), lazy("ramp-deconvolution"), lazy("separable-least-squares"),
    lazy("narx"), lazy("plain"),
    # tests of a residual
    lazy("whiteness"), lazy("structure"),
    # what aligned the clocks of stimulator and load cell
    lazy("sync"), lazy("regression"),
    # directions of a pulse width
    lazy("rising"), lazy("falling"), lazy("held"),
    lazy("rising %(segment)s"), lazy("falling %(segment)s"),
    # how sure, how much
    lazy("very probably"), lazy("probably"), lazy("possibly"), lazy("something"),
    lazy("expired"), lazy("empty"), lazy("1 place"), lazy("%(count)s places"),
    # what is joined
    lazy("%(one)s and %(other)s"), lazy("%(one)s from %(other)s"), lazy("%(name)s (%(form)s)"), lazy(" by %(who)s"),
    lazy("with %(effects)s"),
    # a sentence without the figure that `stimrig.api.structure.worded` takes away; made by `format`
    lazy("%(test)s should separate %(those)s."),
    lazy("%(test)s is the best test to separate %(those)s, but it may not be enough."),
    lazy("pulse widths of %(range)s µs"), lazy("%(range)s pulses/s"),
    # what was not found, what ran
    lazy("file"), lazy("job"), lazy("model"), lazy("participant"), lazy("recording"), lazy("schema"), lazy("test"),
    lazy("token"), lazy("user"), lazy("comparison"), lazy("diagnosis"), lazy("identification"), lazy("prediction"),
    # effects by their ids
    lazy("recruitment hysteresis"), lazy("asymmetric relaxation"), lazy("electromechanical delay"),
    lazy("mixed fibres"), lazy("threshold drift"), lazy("baseline drift"), lazy("voluntary effort"),
    lazy("output saturation"), lazy("sensor clipping"), lazy("series compliance"), lazy("torque angle"),
    lazy("torque velocity"), lazy("passive torque"), lazy("activation dependent speed"), lazy("catch like"),
    lazy("activation_dependent_speed"), lazy("asymmetric_relaxation"), lazy("baseline_drift"), lazy("catch_like"),
    lazy("electromechanical_delay"), lazy("mains_hum"), lazy("mixed_fibres"), lazy("output_saturation"),
    lazy("passive_torque"), lazy("recruitment_hysteresis"), lazy("sensor_clipping"), lazy("series_compliance"),
    lazy("threshold_drift"), lazy("torque_angle"), lazy("torque_velocity"), lazy("voluntary_effort"),
    # what a worker does
    lazy("tried %(effect)s"), lazy("comparing"), lazy("done"), lazy("loading"), lazy("predicting"), lazy("writing"),
    # what a controller's trials tell
    lazy("gain"), lazy("threshold"), lazy("time scale"),
    # limits
    lazy("rig file"), lazy("%(least)s to %(most)s µs"),
    # where in a file
    lazy("%(name)s, line %(line)s"), lazy("%(name)s, sample %(number)s"), lazy("%(name)s, attribute %(attribute)s"),
    lazy("attribute %(name)s"), lazy("recording %(number)s"), lazy("%(unit)s (or %(others)s)"), lazy("negative"),
    # thresholds; states of the rig and of the stimulator
    lazy("comfort"), lazy("motor"), lazy("sensory"), lazy("arming"), lazy("calibrating"), lazy("disconnected"),
    lazy("latched"), lazy("ready"), lazy("stopping"), lazy("uncertain"),
    lazy("not initialised"), lazy("low level initialised"), lazy("mid level initialised"), lazy("mid level running"),
    lazy("did not answer"),
    # why and by whom the rig was stopped; what it answered
    lazy("stop pressed on the page"), lazy("%(reason)s (by %(who)s)"), lazy("device: %(state)s"),
]  # fmt: skip
"""So that the catalogues hold them."""
