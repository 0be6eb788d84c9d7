"""A station that plays a live session throughout, and notes how long its face stood still."""

from __future__ import annotations

import threading
import time

from myoface.client import Client
from myoface.errors import ApiError

FRAME_S = 0.05
OPENS_WITHIN = 60.0


class Station(threading.Thread):
    """Sends frames of a live session on a rig until ``close`` is called, and receives its faces.

    ``longest_s`` is the longest time between two faces that followed, ``since`` the moment when it
    began, by the monotonic clock, ``error`` what ended the session before that.
    """

    def __init__(self, url: str, key: str, rig_id: str) -> None:
        super().__init__(name="station", daemon=True)
        self.session = ""
        self.followed = 0
        self.longest_s = 0.0
        self.since = 0.0
        self.error: str | None = None
        self._where = url, key
        self.rig_id = rig_id
        self._opened = threading.Event()
        self._closing = threading.Event()

    def open(self) -> None:
        """Begin, and wait for the first face."""
        self.start()
        if not self._opened.wait(OPENS_WITHIN):
            raise RuntimeError(f"no face followed: {self.error}")

    def close(self) -> None:
        """End the session."""
        self._closing.set()
        self.join()

    def run(self) -> None:
        """Play frames."""
        try:
            with Client(*self._where) as client, client.live(self.rig_id) as face:
                self.session = face.id
                last = time.monotonic()
                while not self._closing.is_set():
                    face.send([self.followed, 0.5, 1])
                    if face.receive(FRAME_S) is None:
                        continue
                    now = time.monotonic()
                    self._note(last, now)
                    last = now
                    self.followed += 1
                    self._opened.set()
                self._note(last, time.monotonic())
        except ApiError as error:
            self.error = str(error)

    def _note(self, last: float, now: float) -> None:
        if now - last > self.longest_s:
            self.longest_s = now - last
            self.since = last
