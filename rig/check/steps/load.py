"""The dummy load, by a person's word: without it no pulse flows."""

from __future__ import annotations

from stimrig.rig.check.bench import Bench
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 50, "dummy load", True
FAULTS = {
    "wrong_output": Fault(
        "the load is on another output of the stimulator than the rig file names",
        "put the cable on the output of the rig file, or correct channel and connector in [stimulator]",
    )
}


async def look(bench: Bench) -> Finding:
    named = list(bench.outputs.values())
    several = any("." in place for place in named)
    example = "1.1: connector 1 (yellow), channel 1 (red)" if several else "1: the first of side A"
    said = await bench.ask("load", ohm=bench.ohm, example=example, several=several)
    places = [place.strip() for place in said.split(",")]
    figure, bound = f"on {', '.join(places)}", f"on {', '.join(named)}"
    if set(places) != set(named):
        return failed("wrong_output", figure, bound)
    bench.loaded = True
    return passed(figure, bound)
