"""Settings, by environment (prefix ``STIMRIG_``) or by the command line."""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import Annotated, Any
from zoneinfo import available_timezones

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from stimrig.api.errors import SettingsError

PREFIX = "STIMRIG_"
SECRET = ("_KEY", "_TOKEN")
"""Suffixes of settings whose values are not shown."""


class Settings(BaseSettings):
    """Settings of the service. Every field has an environment variable: ``data_dir`` is ``STIMRIG_DATA_DIR``.

    Raises SettingsError: a value does not hold; the message names its environment variable.
    """

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="ignore")

    data_dir: Path = Field(default=Path("var"), description="database, recordings, journals and logs")
    host: str = Field(default="127.0.0.1", description="address to listen on")
    admin_token: SecretStr | None = Field(default=None, description="first administrator's token; default: drawn")
    session_hours: Annotated[float, Field(gt=0, le=24)] = 12.0
    idle_min: Annotated[float, Field(ge=0, le=720)] = Field(
        default=10.0, description="a session ends after so many minutes without a person's action; 0: never by that"
    )
    time_zone: str | None = Field(default=None, description="as Europe/Berlin; default: the machine's")
    secure_cookies: bool = Field(default=False, description="True behind a TLS proxy: cookies over HTTPS only")
    tls_proxy: bool = Field(default=False, description="True: a TLS proxy stands in front; needed to leave loopback")
    database_url: str | None = Field(
        default=None, description="URL of a SQLite or PostgreSQL database; default: SQLite in the data folder"
    )
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    rig_socket: Path | None = Field(default=None, description="Unix socket of the rig process")
    rig_file: Path | None = Field(default=None, description="rig.toml; default: the emulated rig")
    emulated: bool = Field(default=False, description="True: no person is connected, an emulator stands in for the rig")
    workers: Annotated[int, Field(ge=1, le=16)] = 2
    max_upload_mb: Annotated[float, Field(gt=0)] = 64.0
    effects_dir: Path | None = Field(default=None, description="folder of the users' own effects")

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise SettingsError(refusal(error)) from error

    @field_validator("time_zone")
    @classmethod
    def _known_zone(cls, zone: str | None) -> str | None:
        """Check that this machine knows the zone."""
        if zone and zone not in available_timezones():
            raise ValueError("no such time zone on this machine; take one like Europe/Berlin or UTC")
        return zone or None

    @property
    def database(self) -> str:
        """The database's SQLAlchemy URL."""
        return self.database_url or f"sqlite:///{self.data_dir.absolute() / 'stimrig.db'}"

    @property
    def exports_dir(self) -> Path:
        """Folder of files being handed out; emptied at each start."""
        return self.data_dir / "exports"

    @property
    def recordings_dir(self) -> Path:
        """Folder of sealed and uploaded recordings."""
        return self.data_dir / "recordings"

    @property
    def logs_dir(self) -> Path:
        """Folder of the processes' logs."""
        return self.data_dir / "logs"


def refusal(error: ValidationError) -> str:
    """Describe the invalid setting in one line, by the name of its environment variable."""
    first = error.errors()[0]
    name = PREFIX + "_".join(str(part) for part in first["loc"]).upper()
    message = first["msg"].removeprefix("Value error, ")
    value = re.sub(r"//[^/]*@", "//…@", repr(first["input"]))
    return f"{name}: {message}" if name.endswith(SECRET) else f"{name}: {message}, not {value}"


def loopback(host: str) -> bool:
    """Return whether an address is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
