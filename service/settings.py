"""Settings of the API and the worker, from the environment (``MYOFACE_*``)."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

from pydantic import Field, IPvAnyNetwork, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from solver.kinds import Kind

# A unix socket's path must fit into sockaddr_un (104 bytes on macOS, 108 on Linux).
LONGEST_SOCKET_PATH = 100

# Settings that hold passwords: files can have them, which no list of processes or containers shows
SECRETS = ("secret_key", "database_url", "broker_url")


# A site as browsers name it in a request's Origin, or all
ORIGIN = r"^(\*|https?://[a-z0-9.-]+(:[0-9]{1,5})?|https?://\[[0-9a-f:.]+\](:[0-9]{1,5})?)$"


class Settings(BaseSettings):
    """Settings of an installation: places, limits, time limits in seconds."""

    model_config = SettingsConfigDict(env_prefix="MYOFACE_", extra="ignore", frozen=True)

    data_dir: Path = Field(
        default=Path.home() / ".local" / "share" / "myoface", validate_default=True
    )
    database_url: str | None = Field(default=None, description="default: SQLite in data_dir")
    broker_url: str | None = Field(
        default=None, description="default: an embedded Valkey in data_dir"
    )
    files_dir: Path | None = Field(default=None, description="default: data_dir/files")
    files_url: str | None = Field(
        default=None,
        pattern=r"^s3://[^/?]+",
        description="s3://bucket/prefix?endpoint=...&region=..., in place of files_dir",
    )
    uploads_dir: Path | None = Field(
        default=None, description="unfinished uploads; default: files_dir/uploads"
    )
    work_dir: Path | None = Field(
        default=None, description="the attempts, a folder an installation; default: data_dir/work"
    )

    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=0, le=65535)
    allowed_hosts: list[str] = ["127.0.0.1", "localhost"]

    viewer_origins: list[Annotated[str, Field(pattern=ORIGIN)]] = Field(
        default=[],
        description='sites whose pages may read signed URLs, such as https://review.studio; "*": '
        "all",
    )

    secret_key: SecretStr | None = Field(
        default=None,
        min_length=32,
        description="the same for all API processes; default: one made in data_dir",
    )

    rate_per_minute: int = Field(
        default=6000, ge=1, description="requests that a key may send; so many at once, too"
    )
    tenant_rate_per_minute: int = Field(
        default=24_000, ge=1, description="requests that a tenant may send with all its keys"
    )
    unknown_keys_per_minute: int = Field(
        default=600, ge=1, description="keys that have not worked yet, from one address"
    )
    signed_url_seconds: int = Field(
        default=300, ge=1, le=3600, description="how long a signed URL works"
    )
    retain_subjects: int | None = Field(
        default=None, ge=1, description="days after which a subject goes with all that is its own"
    )
    retain_scans: int | None = Field(default=None, ge=1, description="days, of captures")
    retain_jobs: int | None = Field(
        default=None, ge=1, description="days after its end, of a job that no rig needs"
    )
    retain_rigs: int | None = Field(default=None, ge=1, description="days, of a rig and its job")
    retain_audit: int | None = Field(default=None, ge=1, description="days, of the audit log")

    max_upload_bytes: int = Field(default=2 * 1024**3, gt=0)
    upload_ttl: float = Field(default=24 * 3600, gt=0)
    max_open_uploads: int = Field(default=64, ge=1, description="unfinished ones, of a tenant")
    header_timeout: float = Field(default=5, gt=0, description="for a request's headers")
    receive_timeout: float = Field(default=30, gt=0, description="for any body but an upload's")
    min_upload_rate: float = Field(default=1024, gt=0, description="bytes a second")
    send_timeout: float = Field(
        default=60, gt=0, description="for a client that takes nothing of what it is sent"
    )
    max_connections: int = Field(
        default=512,
        ge=2,
        description="per API process; at most 1/2 anonymous, at most 3/4 authenticated",
    )
    max_address_connections: int = Field(
        default=128,
        ge=1,
        description="of one address, before they have shown a key; of more the oldest is closed",
    )
    max_tenant_connections: int = Field(
        default=256,
        ge=1,
        description="of one tenant, in an API process; for another the longest idle is closed",
    )
    max_tenant_streams: int = Field(
        default=128, ge=1, description="of events, open at a time in an API process"
    )
    max_key_streams: int = Field(default=64, ge=1, description="the same, of one key")
    max_tenant_live: int = Field(
        default=64, ge=1, description="connections to live sessions, open in an API process"
    )
    max_key_live: int = Field(default=32, ge=1, description="the same, of one key's tickets")
    max_tenant_downloads: int = Field(
        default=96, ge=1, description="of files, open at a time in an API process"
    )
    max_key_downloads: int = Field(default=48, ge=1, description="the same, of one key")

    max_attempts: int = Field(default=3, ge=1)
    max_ingest_seconds: int | None = Field(
        default=None, ge=1, description="after which an attempt is ended; default: its kind's, 120"
    )
    max_short_seconds: int | None = Field(
        default=None, ge=1, description="default: 3600, of a check of markers 300"
    )
    max_long_seconds: int | None = Field(default=None, ge=1, description="default: 86400")
    max_live_seconds: int | None = Field(
        default=None, ge=1, description="of a live session; default: 90000"
    )
    min_read_rate: float = Field(
        default=1024**2,
        gt=0,
        description="bytes a second: an attempt that reads large files has so much more time",
    )
    lease: float = Field(
        default=30, gt=0, description="a worker silent for so long has lost its job"
    )
    live_silence: float = Field(
        default=1.5,
        gt=0,
        description="a worker silent for so long has lost its live sessions to other hosts'",
    )
    beat: float = Field(
        default=1, gt=0, description="how often a supervisor renews, reports, reads cancels"
    )
    sweep: float = Field(default=5, gt=0, description="pause between two rounds of the sweeper")
    resend_after: float = Field(
        default=10, gt=0, description="first pause before a job is sent again"
    )
    garbage_age: float = Field(
        default=300, gt=0, description="unreferenced files older than this go"
    )

    scrub_per_minute: float = Field(
        default=4, ge=0, description="stored files compared with their names; 0: none"
    )

    ingest_workers: int = Field(default=1, ge=1)
    short_workers: int = Field(default=1, ge=1)
    long_workers: int = Field(default=1, ge=1)
    live_workers: int = Field(
        default=4,
        ge=0,
        description="live sessions at a time, of each of the two workers for them; 0: none here",
    )
    live_standby: int = Field(
        default=1,
        ge=0,
        description="solver processes with their code loaded that wait for sessions, a worker's "
        "(Linux, where they are confined)",
    )
    live_ticket_seconds: int = Field(
        default=60, ge=1, le=3600, description="within which a ticket's connection must be opened"
    )
    solver_threads: int = Field(default=os.cpu_count() or 1, ge=1)
    solver_niceness: int = Field(
        default=10, ge=0, le=19, description="solver processes give way to others; 0: they do not"
    )
    solver_memory_mb: int = Field(default=8192, gt=0)
    solver_confined: bool = Field(
        default=True, description="solver processes can reach nothing but their own folder (Linux)"
    )
    ingest_standby: bool = Field(
        default=True,
        description="solver processes with their code loaded wait for checks, one a worker's job "
        "(Linux, where they are confined)",
    )
    solver_variables: list[str] = Field(
        default=[], description="further variables of the environment that solver processes see"
    )
    tenant_cache_bytes: int = Field(
        default=2 * 1024**3,
        ge=0,
        description="of meshed templates that a host keeps of a tenant; the oldest go",
    )
    jobs: str = Field(
        default="solver.jobs",
        description="package with a module for each kind of job; tests have a stand-in",
    )

    webhook_workers: int = Field(
        default=8, ge=0, description="threads that deliver; 0: no worker for webhooks here"
    )
    webhook_timeout: float = Field(default=10, gt=0)
    webhook_schedule: list[float] = Field(
        default=[5, 300, 1800, 7200, 18000, 36000, 50400, 72000, 86400],
        description="pauses before the further tries",
    )
    webhook_allow: list[IPvAnyNetwork] = Field(
        default=[], description="networks that are not public but may be told, such as 10.1.2.0/24"
    )

    log_json: bool = False
    stack_pid: int | None = Field(default=None, description="the launcher to end with, if any")

    @model_validator(mode="before")
    @classmethod
    def _read_secrets(cls, given: dict[str, Any]) -> dict[str, Any]:
        """Read from a file what ``MYOFACE_..._FILE`` says is in one, as containers get secrets."""
        files = {name: os.environ.get(f"MYOFACE_{name.upper()}_FILE") for name in SECRETS}
        found = {name: Path(file).read_text().strip() for name, file in files.items() if file}
        return {**found, **given}

    @field_validator("data_dir", "files_dir", "uploads_dir", "work_dir")
    @classmethod
    def _absolute(cls, value: Path | None) -> Path | None:
        return value.expanduser().resolve() if value else None

    def max_seconds(self, kind: Kind, input_bytes: int = 0) -> int:
        """Return the seconds after which an attempt at a kind of job is ended.

        Large files have more time, unless it is set.
        """
        own: int | None = getattr(self, f"max_{kind.queue}_seconds")
        return own or kind.max_seconds + int(input_bytes / self.min_read_rate)

    @property
    def sweeper_term(self) -> float:
        """Seconds for which a round of the sweeper shows that it, and its worker, lives."""
        return 3 * self.sweep

    @property
    def admin_key(self) -> Path:
        """The file of the key that the first start makes."""
        return self.data_dir / "admin.key"

    @property
    def database(self) -> str:
        """The database's SQLAlchemy URL; a plain ``postgresql://`` means psycopg."""
        if self.database_url is None:
            return f"sqlite:///{self.data_dir / 'myoface.db'}"
        return self.database_url.replace("postgresql://", "postgresql+psycopg://", 1)

    @property
    def broker(self) -> str:
        """The broker's Celery URL."""
        return self.broker_url or f"redis+socket://{self.broker_socket}"

    @property
    def broker_socket(self) -> Path:
        """Socket of the embedded broker: in data_dir if the path is short enough.

        Else in a folder of this user's alone: who could put a socket there before would be asked
        for jobs in the broker's place.
        """
        path = self.data_dir / "broker" / "valkey.sock"
        if len(str(path)) <= LONGEST_SOCKET_PATH:
            return path
        private = os.environ.get("XDG_RUNTIME_DIR") or Path.home() / ".local" / "state"
        return Path(private) / "myoface" / f"{_short_hash(str(self.data_dir))}.sock"

    @property
    def files(self) -> Path | str:
        """Place of the content-addressed files: a folder, or the URL of a bucket."""
        return self.files_url or self._folder

    @property
    def uploads(self) -> Path:
        """The folder of unfinished uploads, which API processes that take turns must share."""
        return self.uploads_dir or self._folder / "uploads"

    @property
    def work(self) -> Path:
        """The folder of the workers' attempts.

        Each installation has its own, also where several share `work_dir`: their sweepers remove
        the attempts that are not in their own database.
        """
        url = urlsplit(self.database)
        server = url.netloc.rpartition("@")[2]  # without the password, which may change
        return (self.work_dir or self.data_dir / "work") / _short_hash(server + url.path)

    @property
    def _folder(self) -> Path:
        return self.files_dir or self.data_dir / "files"

    def environment(self) -> dict[str, str]:
        """Return these settings as environment variables for a child process."""
        values = self.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
        if self.secret_key:
            values["secret_key"] = self.secret_key.get_secret_value()
        return {f"MYOFACE_{key.upper()}": _as_text(value) for key, value in values.items()}


def _short_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _as_text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)
