"""What can be set at a centre, by environment (prefix ``STIMRIG_CENTRE_``) or by the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field
from pydantic_settings import SettingsConfigDict

from stimrig.api.settings import ServerSettings


class CentreSettings(ServerSettings):
    """Settings of the centre: ``data_dir`` is ``STIMRIG_CENTRE_DATA_DIR``."""

    model_config = SettingsConfigDict(env_prefix="STIMRIG_CENTRE_", extra="ignore")
    centre_url: ClassVar[None] = None
    """A centre tells no other one."""
    structure: ClassVar[tuple[str, ...]] = ()
    """A centre fits nothing."""

    data_dir: Path = Field(default=Path("centre"), description="files that are coming in, and logs")
    database_url: str | None = Field(
        default=None,
        description="as postgresql+psycopg://user:password@host/stimrig; default: SQLite in the data folder",
    )
    files: str | None = Field(
        default=None, description="the bucket: a folder, file:// or s3://bucket/prefix; default: in the data folder"
    )
    port: Annotated[int, Field(ge=0, le=65535)] = 8100
    max_file_mb: Annotated[float, Field(gt=0)] = Field(default=4096.0, description="longest file that is taken, MB")

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
