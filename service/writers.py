"""Places of requests that wait: few of a kind do at a time, and none for long.

A request that waits for a lock keeps one of the process's threads (AnyIO's 40), and if writers had
them all, nobody could read. So a writer waits for a place without a thread, and then for the lock;
both together no longer than its patience. Those that read large files wait for their turn so, too.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from anyio import Semaphore, move_on_after

from service.errors import Problem, busy

# Requests of an API process that write, or wait for the right to, at a time
PLACES = 16
# Seconds that a request waits for a place and the lock
PATIENCE = 5.0


class Places:
    """Places of one API process; ``refuse`` makes the problem of who finds none free in time."""

    def __init__(self, count: int | None = None, refuse: Callable[[], Problem] = busy) -> None:
        self._places = Semaphore(PLACES if count is None else count)
        self._refuse = refuse

    @asynccontextmanager
    async def place(self) -> AsyncIterator[float]:
        """Give a place, and the moment of `time.monotonic` by which the writing must begin.

        Raises
        ------
        Problem
            503 if none is free in time.
        """
        until = time.monotonic() + PATIENCE
        with move_on_after(PATIENCE) as waiting:
            await self._places.acquire()
        if waiting.cancelled_caught:
            raise self._refuse()
        try:
            yield until
        finally:
            self._places.release()
