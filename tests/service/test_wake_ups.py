"""Nobody waits for the broker."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest

from service.queue.wakeups import WakeUps


@pytest.mark.parametrize("state", ["absent", "frozen"])
def test_a_broker_that_does_not_answer_holds_nobody_up(tmp_path: Path, state: str) -> None:
    path = tmp_path / "broker"
    with socket.socket(socket.AF_UNIX) as listening:
        if state == "frozen":  # as a stopped process: connections come about, answers do not
            listening.bind(str(path))
            listening.listen()
        wake_ups = WakeUps(f"redis+socket://{path}")
        began = time.monotonic()
        for number in range(2000):
            wake_ups.send(str(number), "short")
        assert time.monotonic() - began < 1
        wake_ups.close()
        assert time.monotonic() - began < 5
