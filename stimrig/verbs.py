"""The verbs of the command line as functions, but for those with a progress bar: the same work, by the same code."""

from __future__ import annotations

import json
import secrets
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.client.rest import Client
from stimrig.api.progress_bar import progress_bar
from stimrig.identify.inversion import Inversion, Reference
from stimrig.identify.inversion import invert as widths_for
from stimrig.identify.inversion.reference import read_reference
from stimrig.identify.results import Result
from stimrig.identify.summary import Sheet


@dataclass(frozen=True, repr=False, eq=False)
class Report(Result):
    """What a verb reports: `report["records"]` and others, the keys of its `--json` (`stimrig.schema(verb)`)."""

    verb: str
    document: Mapping[str, Any]

    def __getitem__(self, key: str) -> Any:
        return self.document[key]

    def to_dict(self) -> dict[str, Any]:
        """The keys of `--json`."""
        return dict(self.document)

    def _sheet(self) -> Sheet:
        rows = [(name, value if isinstance(value, str) else json.dumps(value)) for name, value in self.document.items()]
        return Sheet(f"stimrig {self.verb}", tuple(rows[:10]))


def join(data: Iterable[str | Path], map: Sequence[str] | None = None) -> identify.Record:
    """Several recordings of one muscle as one record, in the order of time, as each verb joins its DATA.

    `map` as of `read`. Raises BadRecord: a file cannot be read, or they do not go together.

    Parameters
    ----------
    data : iterable of path
        Files.
    map : sequence of str, optional
        Names of columns of other tools, as "torque_nm=Drehmoment:Nm".
    """
    from stimrig.api import record_files

    return record_files.read([Path(path) for path in data], map)


def invert(
    model: identify.Model,
    reference: str | Path | Sequence[float],
    time_s: Sequence[float] | None = None,
    angle_rad: Sequence[float] | None = None,
    largest_us: float | None = None,
    rise_us: float | None = 50.0,
) -> Inversion:
    """The pulse widths with which a model follows a torque best, and what of it is out of reach.

    Parameters
    ----------
    reference : path or sequence of float
        A CSV file; or the torque above rest, N·m: one for each pulse, or one for each of `time_s` (with the joint's
        `angle_rad`, where it moves).
    largest_us, rise_us : float or None
        Widest pulse, and largest rise from pulse to pulse, µs.
    model : Model
        The model.
    time_s : sequence of float, optional
        Of the reference, s.
    angle_rad : sequence of float, optional
        Of the joint at each of them, rad.

    Raises
    ------
    BadModel, BadRecord, BadRequest
        The model cannot be inverted; the reference cannot be read, or used.
    """
    rate_hz = model.pulse_rate_hz
    if isinstance(reference, str | Path):
        wanted = read_reference(Path(reference).read_bytes(), str(reference), rate_hz)
    else:
        wanted = Reference.of(reference, time_s, angle_rad=angle_rad, pulse_rate_hz=rate_hz)
    return widths_for(model, wanted, largest_us=largest_us, rise_us=rise_us)


def table1(trials: int = 100) -> Report:
    """The paper's Table I, ours beside theirs.

    Parameters
    ----------
    trials : int
        Fits for each noise level and method.
    """
    from stimrig.identify import paper

    with progress_bar() as progress:
        return Report("table1", paper.table1(trials, progress))


@contextmanager
def emulate(options: str = "", data: str | Path | None = None) -> Iterator[Client]:
    """An emulated rig with its service, for a `with` statement: no device, and no person, is connected.

    Parameters
    ----------
    options : str
        Of the emulator, as "--patient changing".
    data : path, optional
        Folder for its recordings and models; default: one that is deleted at the end.

    Yields
    ------
    Client
        Of the running service.

    Raises
    ------
    LaunchError
        A process does not come up, or the extra `page` is not installed.
    """
    from stimrig.api.cli.errors import LaunchError

    try:
        from stimrig.api.cli.supervisor import Services
        from stimrig.api.settings import Settings
    except ModuleNotFoundError as error:
        raise LaunchError(f"needs more packages: pip install 'stimrig[page]' ({error.name} is missing)") from None

    token = secrets.token_urlsafe(32)
    with tempfile.TemporaryDirectory(prefix="stimrig-") as folder:
        settings = Settings(data_dir=Path(data or folder), port=0, rig_file=None)
        with Services(settings, options.split(), token) as services, Client(services.url, token) as client:
            yield client
