"""A crowd of clients without a key, each of which keeps the service waiting as long as it may."""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter

from service.access.keys import LETTERS, _checksum

HOST = b"Host: 127.0.0.1\r\n"
JSON = b"Content-Type: application/json\r\nContent-Length: 60000\r\n\r\n"
DRIP_EVERY = 0.5
RETURN_AFTER = 10.0


def forged_key() -> bytes:
    """Return a key that nobody was given, of the right form: the checksum is no secret."""
    body = "myo_" + LETTERS[7] * 44
    return f"Authorization: Bearer {body}{_checksum(body)}\r\n".encode()


# What each sends at once; then a byte now and then
OPENINGS = {
    "silent": b"",
    "slow headers": b"GET / HTTP/1.1\r\n" + HOST + b"X-Slow: ",
    "slow body": b"POST /v1/jobs HTTP/1.1\r\n" + HOST + JSON,
    "slow body, forged key": b"POST /v1/jobs HTTP/1.1\r\n" + HOST + forged_key() + JSON,
}


def besiege(port: int, count: int, seconds: float) -> Counter[str]:
    """Besiege a port for some seconds; returns how the connections ended."""
    crowd = Crowd(port, count)
    asyncio.run(crowd.besiege(seconds))
    return crowd.ends


class Crowd:
    """``count`` clients who come back whenever they are closed; ``ends`` counts how."""

    def __init__(self, port: int, count: int) -> None:
        self.ends: Counter[str] = Counter()
        self._port = port
        self._count = count
        self._is_over = False

    async def besiege(self, seconds: float) -> None:
        """Keep the service waiting for some seconds."""
        kinds = itertools.islice(itertools.cycle(OPENINGS), self._count)
        tasks = [asyncio.create_task(self._stay(kind, i)) for i, kind in enumerate(kinds)]
        await asyncio.sleep(seconds)
        self._is_over = True
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks, timeout=30)

    async def _stay(self, kind: str, number: int) -> None:
        own = f"127.0.{1 + number % 4}.1"  # a few addresses, as one who rents some machines has
        await asyncio.sleep(number / self._count)
        while not self._is_over:
            try:
                opened = asyncio.open_connection("127.0.0.1", self._port, local_addr=(own, 0))
                reader, writer = await asyncio.wait_for(opened, 10)
            except (OSError, TimeoutError):
                self.ends["not let in"] += 1
                await asyncio.sleep(1)
                continue
            try:
                self.ends[f"{kind}: {await self._dawdle(kind, reader, writer)}"] += 1
            except OSError:
                self.ends[f"{kind}: cut off"] += 1
            finally:
                writer.close()
            await asyncio.sleep(RETURN_AFTER)

    async def _dawdle(
        self, kind: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> str:
        writer.write(OPENINGS[kind])
        answer = asyncio.create_task(reader.read(64))
        answer.add_done_callback(lambda done: done.cancelled() or done.exception())
        while not answer.done() and not self._is_over:
            await asyncio.wait([answer], timeout=DRIP_EVERY)
            if kind != "silent":
                writer.write(b"x")
        line = (await answer).split(b"\r\n")[0]
        return line[9:12].decode() or "cut off"
