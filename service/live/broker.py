"""The broker as connections to live sessions use it: they wait for it without a thread each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff

from service.errors import Problem
from service.queue.streams import ADD, KEPT_SECONDS, MOST_IN, Answered, Names, Sent
from service.queue.wakeups import client_url

ASKS = 1.0  # s that the broker is asked for news at a time
PATIENCE = 0.5  # s that it has to answer otherwise


class LiveBroker:
    """Streams of all sessions; every call may raise one of `wakeups.AWAY`."""

    def __init__(self, broker_url: str) -> None:
        url = client_url(broker_url)
        once = Retry(NoBackoff(), 0)
        self._client = Redis.from_url(
            url, socket_timeout=PATIENCE, socket_connect_timeout=PATIENCE, retry=once
        )
        self._waiting = Redis.from_url(
            url, socket_timeout=ASKS + PATIENCE, socket_connect_timeout=PATIENCE, retry=once
        )
        self._add = self._client.register_script(ADD)

    async def use(self, nonce: str, seconds: int) -> bool:
        """Use a ticket; False: it has been used before."""
        return bool(await self._client.set(f"live:ticket:{nonce}", "", nx=True, ex=2 * seconds))

    async def take_seat(self, names: Names, station: str) -> None:
        """Make a connection the station's, in the place of the one before."""
        await self._client.set(names.station, station, ex=KEPT_SECONDS)

    async def has_seat(self, names: Names, station: str) -> bool:
        """Return whether no other connection is the station's."""
        return await self._client.get(names.station) in (None, station.encode())

    async def add(self, names: Names, sent: Sent) -> bool:
        """Add what a station sent; False: another connection is the station's."""
        fields = [part for pair in sent.fields().items() for part in pair]
        given = [sent.station, MOST_IN, KEPT_SECONDS, *fields]
        return bool(await self._add([names.into, names.station], given))

    async def tell(self, names: Names, sent: Sent) -> None:
        """Add what the service itself says to a session."""
        await self._client.xadd(names.into, sent.fields(), maxlen=MOST_IN, approximate=False)
        await self._client.expire(names.into, KEPT_SECONDS)

    async def told(self, names: Names) -> tuple[bytes, dict[bytes, bytes]]:
        """Return where a session's answers go on, and its last words of each type before."""
        newest: Any = await self._client.xrevrange(names.out, count=1)
        last = newest[0][0] if newest else b"0"
        told: Any = await self._client.hgetall(names.told)
        return last, told

    async def answers(self, names: Names, last: bytes) -> tuple[bytes, Sequence[Answered]]:
        """Return a session's answers after ``last``, and where they go on, within a second."""
        found: Any = await self._waiting.xread({names.out: last}, block=round(1000 * ASKS))
        entries = found[0][1] if found else []
        place = entries[-1][0] if entries else last
        return place, [Answered.read(fields) for _, fields in entries]

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()
        await self._waiting.aclose()


def unreachable() -> Problem:
    """Return the problem of a broker that does not answer."""
    problem = Problem(503, "live.unreachable", "the broker does not answer; try again")
    problem.headers = {"Retry-After": "1"}
    return problem
