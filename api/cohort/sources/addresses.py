"""From what is typed as DATA to its source."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from stimrig.api.cohort.errors import CohortError
from stimrig.api.cohort.sources import Source
from stimrig.api.cohort.sources.bucket import Bucket
from stimrig.api.cohort.sources.centre import Centre
from stimrig.api.cohort.sources.folder import Folder
from stimrig.api.settings import loopback


def sources_of(addresses: Sequence[str], token: str = "", scheduler: str = "") -> list[Source]:
    """A source for each address; `scheduler`: where they are sent to, with the token; empty: to this machine only.

    Raises
    ------
    CohortError
        An address that cannot be used, a centre without a token, or a token that would travel in the clear.
    """
    if not addresses:
        raise CohortError("DATA is missing. Give files, folders, s3://… or the https://… of a centre.")
    sources = [_source(address, token) for address in addresses]
    if any(isinstance(source, Centre) for source in sources) and scheduler and not scheduler.startswith("tls://"):
        raise CohortError(
            f"--scheduler {scheduler}: the token would go on to the workers in the clear, wherever they are. "
            "Start the scheduler with TLS and give tls://… (docs/cohorts.md)."
        )
    return sources


def _source(address: str, token: str) -> Source:
    protocol, separator, rest = address.partition("://")
    if not separator:
        return Folder(str(Path(address)))
    if protocol in ("http", "https"):
        if not token:
            raise CohortError(f"{address}: a centre needs a token. Set STIMRIG_TOKEN, or give --token.")
        if protocol == "http" and not loopback(urlsplit(address).hostname or ""):
            raise CohortError(f"{address}: the token would be sent in the clear. Give https://…")
        return Centre(address.rstrip("/"), token)
    if protocol == "file":
        return Folder(rest)
    return Bucket(address)
