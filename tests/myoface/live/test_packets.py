"""Packets of Live Link Face and OSC: what is read of good ones, and that bad ones are refused."""

from __future__ import annotations

import random
import struct
from array import array
from collections.abc import Callable
from math import nan

import pytest

from myoface.client import LiveFrame, Timed
from myoface.live.datagrams import PacketError
from myoface.live.live_link import NAMES, read_packet
from myoface.live.osc import BUNDLE, LONGEST, OscMessage, read_osc, write_osc
from myoface.live.osc_faces import OscReader, write_face
from solver.scans.live_link import ANGLES, ARKIT_NAMES
from tests.myoface.live.packets import live_link_packet


def test_a_packet_of_live_link_face_is_read() -> None:
    given = {"jawOpen": 0.5, "mouthLeft": 0.25, "rightEyeRoll": -0.125}

    reading = read_packet(live_link_packet(given, 120))

    assert reading is not None
    assert reading.seconds == pytest.approx(120.25 / 60)
    assert isinstance(reading.numbers, dict)
    assert {name: value for name, value in reading.numbers.items() if value} == given
    assert set(NAMES) == {*ARKIT_NAMES, *(name for names in ANGLES.values() for name in names)}


def test_a_packet_without_a_face_is_none() -> None:
    whole = live_link_packet({}, 1)
    without = whole[: -4 * len(NAMES) - 1] + b"\0"
    assert read_packet(without) is None


@pytest.mark.parametrize("rate", [0, -1, 1_000_000])
def test_a_packet_with_no_rate_is_refused(rate: int) -> None:
    with pytest.raises(PacketError, match="no rate"):
        read_packet(live_link_packet({}, 1, rate=rate))


def test_osc_is_read_as_it_is_written() -> None:
    messages = [OscMessage(f"/value/{n}", (n, 0.5, "text")) for n in range(200)]

    packets = list(write_osc(messages))

    assert all(len(packet) <= LONGEST for packet in packets)
    assert [found for packet in packets for found in read_osc(packet)] == messages


def test_osc_of_others_is_read() -> None:
    # an example of the specification, and types that it lists beside the usual ones
    known = b"/oscillator/4/frequency\0,f\0\0\x43\xdc\0\0"
    assert list(read_osc(known)) == [OscMessage("/oscillator/4/frequency", (440.0,))]
    more = b"/a\0\0,dhTFb\0\0" + struct.pack(">dqi", 0.1, 1 << 40, 2) + b"xy\0\0"
    assert list(read_osc(more)) == [OscMessage("/a", (0.1, 1 << 40, True, False, b"xy"))]


def test_a_part_of_negative_length_ends_a_bundle() -> None:
    with pytest.raises(PacketError, match="-4 bytes"):
        list(read_osc(BUNDLE + bytes(8) + struct.pack(">i", -4) + b"/abc"))


def test_bundles_within_bundles_end() -> None:
    packet = b"/a\0\0"
    for _ in range(2000):
        packet = BUNDLE + bytes(8) + struct.pack(">i", len(packet)) + packet
    with pytest.raises(PacketError, match="deep"):
        list(read_osc(packet))


def vmc(name: str, weight: float) -> bytes:
    head = b"/VMC/Ext/Blend/Val\0\0,sf\0"
    text = name.encode() + b"\0"
    return head + text + b"\0" * (-len(text) % 4) + struct.pack(">f", weight)


def test_weights_are_gathered_until_the_frame_is_whole() -> None:
    reader = OscReader()

    assert reader.read(vmc("jawOpen", 0.5)) is None
    assert reader.read(vmc("browInnerUp", 0.25)) is None
    reading = reader.read(b"/VMC/Ext/Blend/Apply\0\0\0\0,\0\0\0")

    assert reading is not None
    assert reading.numbers == {"jawOpen": 0.5, "browInnerUp": 0.25}
    assert reader.read(b"/VMC/Ext/Blend/Apply\0\0\0\0,\0\0\0") is None  # nothing came since


def test_a_face_that_is_sent_can_be_read_as_a_frame() -> None:
    arrays = {name: array("f", [0.0] * size) for name, size in (("head", 16), ("jaw", 5))}
    arrays |= {"values": array("f", [0.5]), "contractions": array("f", [0.125, nan])}
    face = LiveFrame(7, 50_000.016, 1.5, 0.1, 0.2, 0, False, False, False, arrays)
    ready = {"sliders": ["jawOpen"], "muscles": ["zygomaticus major l", "unknown"]}
    packets = list(write_face(face, ready))
    sent = {found.address: found.arguments for packet in packets for found in read_osc(packet)}
    assert sent["/myoface/contraction/zygomaticus_major_l"] == (0.125,)
    assert not [address for address in sent if "unknown" in address]

    reader = OscReader()
    readings = [reader.read(packet) for packet in packets]

    assert readings[-1] == Timed(50_000.016, {"jawOpen": 0.5})


WHOLE = [OscMessage("/myoface/value/jawOpen", (0.5,)), OscMessage("/myoface/frame", ())]
PACKETS: list[tuple[Callable[[bytes], object], bytes]] = [
    (read_packet, live_link_packet({"jawOpen": 0.5}, 120)),
    (lambda data: OscReader().read(data), vmc("jawOpen", 0.5)),
    (lambda data: OscReader().read(data), next(write_osc(WHOLE))),
]


@pytest.mark.parametrize(("read", "good"), PACKETS)
def test_mutated_packets_are_read_or_refused(read: Callable[[bytes], object], good: bytes) -> None:
    chance = random.Random(0)
    refused = 0
    for _ in range(5000):
        packet = bytearray(good)
        for _ in range(chance.randint(1, 4)):
            place = chance.randrange(len(packet))
            packet[place] = chance.randrange(256)
        if chance.random() < 0.5:
            del packet[chance.randrange(len(packet)) :]
        if chance.random() < 0.2:
            packet += chance.randbytes(8)
        try:
            read(bytes(packet))
        except PacketError:
            refused += 1
    assert refused > 1000
