"""What can be set at a centre, by environment (prefix ``STIMRIG_CENTRE_``) or by the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any
from zoneinfo import available_timezones

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from api.errors import SettingsError
from api.settings import refusal


class CentreSettings(BaseSettings):
    """Settings of the centre.

    Every field has an environment variable: ``data_dir`` is ``STIMRIG_CENTRE_DATA_DIR``.

    Raises
    ------
    SettingsError
        A value does not hold; the message names its environment variable.
    """

    model_config = SettingsConfigDict(env_prefix="STIMRIG_CENTRE_", extra="ignore")

    data_dir: Path = Field(default=Path("centre"), description="files that are coming in, and logs")
    database_url: str | None = Field(
        default=None,
        description="as postgresql+psycopg://user:password@host/stimrig; default: SQLite in the data folder",
    )
    files: str | None = Field(
        default=None, description="the bucket: a folder, file:// or s3://bucket/prefix; default: in the data folder"
    )
    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: Annotated[int, Field(ge=0, le=65535)] = 8100
    admin_token: SecretStr | None = Field(default=None, description="first administrator's token; default: drawn")
    session_hours: Annotated[float, Field(gt=0, le=24)] = 12.0
    idle_lock_min: Annotated[float, Field(ge=0, le=720)] = Field(
        default=10.0, description="a session locks after so many minutes without a person's action; 0: never"
    )
    time_zone: str | None = Field(default=None, description="as Europe/Berlin; default: the machine's")
    secure_cookies: bool = Field(default=False, description="True behind a TLS proxy: cookies over HTTPS only")
    tls_proxy: bool = Field(default=False, description="True: a TLS proxy stands in front; needed to leave loopback")
    max_file_mb: Annotated[float, Field(gt=0)] = Field(default=4096.0, description="longest file that is taken, MB")

    def __init__(self, **given: Any) -> None:
        try:
            super().__init__(**given)
        except ValidationError as error:
            raise SettingsError(refusal(error).replace("STIMRIG_", "STIMRIG_CENTRE_", 1)) from error

    @field_validator("time_zone")
    @classmethod
    def _known_zone(cls, given: str | None) -> str | None:
        if given and given not in available_timezones():
            raise ValueError("no such time zone on this machine; take one like Europe/Berlin or UTC")
        return given or None

    @property
    def database(self) -> str:
        """The database's SQLAlchemy URL."""
        return self.database_url or f"sqlite:///{self.data_dir.absolute() / 'centre.db'}"

    @property
    def bucket(self) -> str:
        """Where whole files lie."""
        return self.files or str(self.data_dir.absolute() / "files")

    @property
    def spool_dir(self) -> Path:
        """Where a file lies until it is whole."""
        return self.data_dir / "spool"

    @property
    def exports_dir(self) -> Path:
        """Where a file lies while it is handed out; emptied at each start."""
        return self.data_dir / "exports"

    @property
    def centre_url(self) -> None:
        """A centre tells no other one."""

    @property
    def structure(self) -> tuple[str, ...]:
        """A centre fits nothing."""
        return ()
