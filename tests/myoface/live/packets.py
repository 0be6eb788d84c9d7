"""Packets as senders of faces make them, written here by what their protocols say."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from myoface.live.live_link import NAMES


def live_link_packet(
    values: Mapping[str, float], frame: int, *, subject: str = "iPhone", rate: int = 60
) -> bytes:
    """Return a packet of Live Link Face; values that are not given are 0."""
    device = b"BBC5F6E4-6D0A-4A4C-8B0F-2B2B2B2B2B2B"
    numbers = [values.get(name, 0.0) for name in NAMES]
    return b"".join(
        [
            *(b"\x06", struct.pack(">i", len(device)), device),
            *(struct.pack(">i", len(subject)), subject.encode()),
            struct.pack(">ifii", frame, 0.25, rate, 1),
            *(struct.pack(">B", len(numbers)), struct.pack(f">{len(numbers)}f", *numbers)),
        ]
    )
