"""Frames that come by UDP: from one address, anything else counted and never answered."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from ipaddress import ip_address

import anyio

from myoface.client import Timed

Parse = Callable[[bytes], Timed | None]  # raises PacketError for what is no packet of its kind


class PacketError(ValueError):
    """What came is no frame."""


@dataclass
class PacketCounts:
    """Packets that came to a port."""

    good: int = 0
    garbage: int = 0  # of the allowed address, but no packets of the kind
    foreign: int = 0  # of other addresses, unread


class Port:
    """A UDP port that frames come to from ``allowed``.

    Without ``allowed`` it is the address that the first good packet is from.
    """

    def __init__(self, port: int, parse: Parse, allowed: str | None = None) -> None:
        self.counts = PacketCounts()
        self.number = port  # 0: any that is free, known once it is open
        self.allowed = None if allowed is None else str(ip_address(allowed))
        self._parse = parse

    async def frames(self, opened: Callable[[], None] = lambda: None) -> AsyncIterator[Timed]:
        """Yield frames as they come, without an end; ``opened`` is called once there can be any.

        Raises OSError if the port is another program's.
        """
        everywhere = "::" if self.allowed and ":" in self.allowed else "0.0.0.0"
        async with await anyio.create_udp_socket(
            local_host=everywhere, local_port=self.number
        ) as socket:
            self.number = socket.extra(anyio.abc.SocketAttribute.local_port)
            opened()
            async for data, (address, _) in socket:
                frame = self._read(data, address)
                if frame is not None:
                    yield frame

    def _read(self, data: bytes, address: str) -> Timed | None:
        if self.allowed is not None and address != self.allowed:
            self.counts.foreign += 1
            return None
        try:
            frame = self._parse(data)
        except PacketError:
            self.counts.garbage += 1
            return None
        self.counts.good += 1
        if frame is not None:
            self.allowed = address
        return frame
