"""The broker: killed, emptied, frozen."""

from __future__ import annotations

import signal
import time

import redis

from tests.campaigns.chaos.blows.workers import kill
from tests.campaigns.chaos.stage import Stage

PAUSE = 6.0


def kill_broker(stage: Stage) -> bool:
    """Kill the broker; the stack starts it again."""
    return kill(stage.stack.pid("broker"), signal.SIGKILL)


def empty_broker(stage: Stage) -> bool:
    """Forget every message."""
    path = str(stage.stack.settings.broker_socket)
    with redis.Redis(unix_socket_path=path) as client:
        return bool(client.flushall())


def pause_broker(stage: Stage) -> bool:
    """Freeze the broker while jobs are submitted: it takes connections and never answers."""
    pid = stage.stack.pid("broker")
    kill(pid, signal.SIGSTOP)
    try:
        stage.submit(len(stage.good) + 2)
        time.sleep(PAUSE)
    finally:
        kill(pid, signal.SIGCONT)
    return True
