"""Workers of a second host: more processes beside the stack's own, started again at once."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from types import TracebackType

from service.settings import Settings


class Crew(threading.Thread):
    """Keeps a worker for each of ``queues`` alive; they end with this thread."""

    def __init__(self, settings: Settings, python_path: str, queues: tuple[str, ...]) -> None:
        super().__init__(name="crew", daemon=True)
        self._environment = os.environ | settings.environment() | {"PYTHONPATH": python_path}
        self._log = settings.data_dir / "logs" / "crew.log"
        self._queues = queues
        self._workers: dict[int, subprocess.Popen[bytes]] = {}
        self._stopping = threading.Event()

    def run(self) -> None:
        """Start who is not there until told to stop."""
        while not self._stopping.wait(0.2):
            for number, queue in enumerate(self._queues):
                worker = self._workers.get(number)
                if worker is None or worker.poll() is not None:
                    self._workers[number] = self._start(queue)
        for worker in self._workers.values():
            worker.terminate()
        for worker in self._workers.values():
            try:
                worker.wait(8)
            except subprocess.TimeoutExpired:
                worker.kill()
                worker.wait()

    def __enter__(self) -> Crew:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stopping.set()
        self.join()

    def _start(self, queue: str) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as output:
            return subprocess.Popen(
                [sys.executable, "-m", "worker", queue],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=self._environment,
                start_new_session=True,
            )
