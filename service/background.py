"""Background threads of the API: each does a round every few seconds."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod

import structlog

log = structlog.get_logger()


class Background(threading.Thread, ABC):
    """A thread that does a round every ``pause`` s until it is stopped."""

    def __init__(self, name: str, pause: float) -> None:
        super().__init__(name=name, daemon=True)
        self._pause = pause
        self._stopping = threading.Event()

    def run(self) -> None:
        """Do rounds; what keeps one from its end does not keep the next from being tried."""
        while not self._stopping.wait(self._pause):
            try:
                self._round()
            except Exception as error:  # whatever it is, the next round must come
                log.warning(f"{self.name}.failed", error=str(error), exc_info=True)

    def stop(self) -> None:
        """Stop after the present round."""
        self._stopping.set()
        self.join()

    @abstractmethod
    def _round(self) -> None:
        """Do what is to be done now."""
