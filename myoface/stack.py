"""The whole service on one machine: broker, API and workers as child processes, kept alive."""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO

import httpx
import structlog

from myoface.errors import StackError
from service.queue.wakeups import LIVE, QUEUES, WEBHOOKS
from service.settings import Settings
from service.store.broker import BrokerNotFoundError, EmbeddedBroker

START_TIMEOUT = 60.0  # s until every part answers
STOP_TIMEOUT = 8.0  # s until a child that does not end is killed
LONGEST_PAUSE = 30.0  # s between two starts of a child
SPARE = "live-spare"  # the second worker for live sessions
RETRY = 2.0  # s after a start that failed
# Of the API: with an arena for each thread, glibc would keep memory that is done with.
FEW_ARENAS = {"MALLOC_ARENA_MAX": "2"}
STEADY = 30.0  # seconds after which a restarted child counts as well

log = structlog.get_logger()


def free_port(host: str) -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind((host, 0))
        port: int = probe.getsockname()[1]
        return port


def check_port(host: str, port: int) -> None:
    """Raise :class:`OSError` if somebody listens on the port, or it may not be used."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((host, port))


class Stack:
    """Starts and stops the service; a child that dies is started again, with growing pauses.

    One stack serves a data folder at a time. ``settings.port`` 0 takes a free port. Each child
    logs to ``<data_dir>/logs/<name>.log``.
    """

    def __init__(self, settings: Settings) -> None:
        port = settings.port or free_port(settings.host)
        self.settings = settings.model_copy(update={"port": port, "stack_pid": os.getpid()})
        self.url = f"http://{settings.host}:{port}"
        self._broker = (
            None
            if settings.broker_url
            else EmbeddedBroker(settings.data_dir / "broker", settings.broker_socket)
        )
        environment = os.environ | self.settings.environment()
        logs = settings.data_dir / "logs"
        asked_for = {LIVE: settings.live_workers, WEBHOOKS: settings.webhook_workers}
        self._queues = [name for name in (*QUEUES, WEBHOOKS) if asked_for.get(name, 1)]
        workers = {name: name for name in self._queues}
        if LIVE in workers:
            workers[SPARE] = LIVE  # goes on with the sessions of the other one if that dies
        self._children = [
            _Child("api", ["-m", "service"], logs, environment | FEW_ARENAS),
            *(
                _Child(name, ["-m", "worker", queue], logs, environment)
                for name, queue in workers.items()
            ),
        ]
        self._stopping = threading.Event()
        self._keeper = threading.Thread(target=self._keep, name="keeper", daemon=True)
        self._lock: IO[str] | None = None

    def start(self) -> None:
        """Start everything and wait until the API and a worker per queue answer.

        Raises
        ------
        StackError
            If another stack has the data folder, the port is taken, there is no broker to start, or
            a part does not come up within a minute; the message names the log to read.
        """
        self._lock = _lock(self.settings.data_dir)
        try:
            self._check_port()
            if self._broker:
                self._broker.start()
            self._keeper.start()
            self._wait_until_ready()
        except BrokerNotFoundError as error:
            self.stop()
            raise StackError(str(error)) from error
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Stop everything; running jobs go back to the queue."""
        self._stopping.set()
        if self._keeper.is_alive():
            self._keeper.join()
        for child in self._children:
            child.terminate()
        for child in self._children:
            child.wait(STOP_TIMEOUT)
        if self._broker:
            self._broker.stop()
        if self._lock:
            self._lock.close()

    def wait(self) -> None:
        """Wait for Ctrl-C or SIGTERM."""
        asked = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: asked.set())
        asked.wait()

    @property
    def key(self) -> str:
        """The key that the first start in the data folder made."""
        return self.settings.admin_key.read_text()

    def pid(self, name: str) -> int:
        """Return the process id of ``broker``, ``api`` or a queue's worker."""
        if name == "broker" and self._broker:
            return self._broker.pid
        return next(child.pid for child in self._children if child.name == name)

    def __enter__(self) -> Stack:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _check_port(self) -> None:
        host = self.settings.host
        port = self.settings.port
        try:
            check_port(host, port)
        except OSError as error:
            raise StackError(f"port {port} of {host} is taken; set MYOFACE_PORT") from error

    def _keep(self) -> None:
        """Start the children here: they end with the thread that started them."""
        for child in self._children:
            child.start()
        while not self._stopping.wait(0.2):
            try:
                self._revive()
            except (BrokerNotFoundError, OSError) as error:
                log.warning("stack.not_revived", error=str(error))
                self._stopping.wait(RETRY)

    def _revive(self) -> None:
        if self._broker and self._broker.has_died():
            log.warning("broker.died")
            self._broker.start()
        for child in self._children:
            child.revive()

    def _wait_until_ready(self) -> None:
        deadline = time.monotonic() + START_TIMEOUT
        while time.monotonic() < deadline:
            if self._is_ready():
                return
            for child in self._children:
                if child.restarts >= 3:
                    raise StackError(f"{child.name} does not start; see {child.log}")
            time.sleep(0.1)
        raise StackError(f"the service did not come up; see {self.settings.data_dir / 'logs'}")

    def _is_ready(self) -> bool:
        try:
            answer = httpx.get(f"{self.url}/readyz", timeout=5, trust_env=False)  # no proxy
            queues = set(answer.json()["workers"])
        except (httpx.HTTPError, ValueError, KeyError):
            return False
        return answer.status_code == 200 and queues >= set(self._queues)


@dataclass
class _Child:
    """A Python process that is started again when it dies."""

    name: str
    arguments: list[str]
    logs: Path
    environment: dict[str, str]
    restarts: int = 0
    _process: subprocess.Popen[bytes] | None = None
    _started: float = 0.0
    _due: float | None = field(default=None)

    @property
    def log(self) -> Path:
        return self.logs / f"{self.name}.log"

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        self.logs.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.log.touch(mode=0o600)
        with self.log.open("ab") as output:
            # A session of its own: Ctrl-C at the terminal is for the stack, which stops in order.
            self._process = subprocess.Popen(
                [sys.executable, *self.arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=self.environment,
                start_new_session=True,
            )
        self._started = time.monotonic()
        self._due = None

    def revive(self) -> None:
        """Start again if dead: at once the first time, then after pauses that double."""
        if self._process is None or self._process.poll() is None:
            return
        now = time.monotonic()
        if self._due is None:
            if now - self._started > STEADY:
                self.restarts = 0
            pause = min(0.5 * (2**self.restarts - 1), LONGEST_PAUSE)
            self._due = now + pause
            log.warning("child.died", name=self.name, code=self._process.returncode, again_in=pause)
        if now >= self._due:
            self.restarts += 1
            self.start()

    def terminate(self) -> None:
        if self._process and self._process.poll() is None:
            self._process.terminate()

    def wait(self, seconds: float) -> None:
        if self._process is None:
            return
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _lock(data_dir: Path) -> IO[str]:
    data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    lock = (data_dir / "stack.lock").open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        lock.close()
        raise StackError(f"a service is running in {data_dir} already") from error
    return lock
