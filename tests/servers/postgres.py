"""A PostgreSQL of one's own, never the machine's."""

from __future__ import annotations

import getpass
import os
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg

from tests.servers import UnavailableError, free_port

PASSWORD = "only for tests"


@contextmanager
def postgres(host: str = "127.0.0.1") -> Iterator[str]:
    """Run a server on a free port; gives the URL of its first database."""
    programs = _programs()
    as_user: list[str] = []
    user = getpass.getuser()
    folder = Path(tempfile.mkdtemp(prefix="myoface-postgres-"))
    try:
        if os.geteuid() == 0:  # initdb refuses to run as root
            if shutil.which("runuser") is None:
                raise UnavailableError("PostgreSQL does not run as root, and there is no runuser")
            user = "postgres"
            as_user = ["runuser", "-u", user, "--"]
            shutil.chown(folder, user)
        port = free_port(host)
        data, log, password = folder / "data", folder / "log", folder / "password"
        password.write_text(PASSWORD)
        password.chmod(0o644)

        def control(*words: str | Path) -> None:
            command = [*as_user, *map(str, words)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd="/", timeout=60)

        access = ["-U", user, "-A", "scram-sha-256", "--pwfile", str(password)]
        control(programs / "initdb", "-D", data, *access, "--no-sync")
        with (data / "pg_hba.conf").open("a") as rules:
            rules.write("host all all samenet scram-sha-256\n")
        options = f"-c listen_addresses={host} -c port={port} -c unix_socket_directories={folder}"
        start: list[str | Path] = [
            "-D",
            data,
            "-l",
            log,
            "-o",
            f"{options} -c fsync=off",
            "-w",
            "start",
        ]
        control(programs / "pg_ctl", *start)
        try:
            secret = PASSWORD.replace(" ", "%20")
            yield f"postgresql://{user}:{secret}@{host}:{port}/postgres"
        finally:
            control(programs / "pg_ctl", "-D", data, "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def fresh_database(url: str) -> str:
    """Make an empty database on a server; returns its URL."""
    name = f"test_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return url.rpartition("/")[0] + f"/{name}"


def _programs() -> Path:
    """Return the folder of the server's programs, which Debian keeps off PATH."""
    if on_path := shutil.which("initdb"):
        return Path(on_path).resolve().parent
    for folder in sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True):
        if (folder / "initdb").exists():
            return folder
    raise UnavailableError("no PostgreSQL server here (initdb): apt-get install postgresql")
