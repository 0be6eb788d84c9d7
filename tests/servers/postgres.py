"""A PostgreSQL of one's own, never the machine's."""

from __future__ import annotations

import getpass
import os
import shutil
import signal
import subprocess
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

import psycopg

from tests.servers import UnavailableError, free_port, listening

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
            if shutil.which("setpriv") is None:
                raise UnavailableError("PostgreSQL does not run as root, and there is no setpriv")
            user = "postgres"
            as_user = ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups"]
            as_user += ["--pdeathsig", "QUIT", "--"]
            shutil.chown(folder, user)
        port = free_port(host)
        data = folder / "data"
        log = folder / "log"
        password = folder / "password"
        password.write_text(PASSWORD)
        password.chmod(0o644)

        access = ["-U", user, "-A", "scram-sha-256", "--pwfile", password, "--no-sync"]
        command = [*as_user, programs / "initdb", "-D", data, *access]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd="/", timeout=60)
        with (data / "pg_hba.conf").open("a") as rules:
            rules.write("host all all samenet scram-sha-256\n")
        options = {
            "listen_addresses": host,
            "port": port,
            "unix_socket_directories": folder,
            "fsync": "off",
        }
        words = [word for key, value in options.items() for word in ("-c", f"{key}={value}")]
        server = [*as_user, programs / "postgres", "-D", data, *words]
        # SIGQUIT: at once, without waiting for clients to leave
        with listening(server, log, host, port, end=signal.SIGQUIT, cwd="/"):
            _wait_for(url := f"postgresql://{user}:{quote(PASSWORD)}@{host}:{port}/postgres")
            yield url
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _wait_for(url: str) -> None:
    """Wait until the server takes sessions: it listens a little earlier."""
    while True:
        try:
            psycopg.connect(url).close()
        except psycopg.OperationalError as error:
            if "starting up" not in str(error):
                raise
            time.sleep(0.05)
        else:
            return


def fresh_database(url: str) -> str:
    """Make an empty database on a server; returns its URL.

    Connections are waited for longer than a service does: this machine may be busy with tests.
    """
    name = f"test_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return url.rpartition("/")[0] + f"/{name}?connect_timeout=60"


def _programs() -> Path:
    """Return the folder of the server's programs, which Debian keeps off PATH."""
    if on_path := shutil.which("initdb"):
        return Path(on_path).resolve().parent
    for folder in sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True):
        if (folder / "initdb").exists():
            return folder
    raise UnavailableError("no PostgreSQL server here (initdb): apt-get install postgresql")
