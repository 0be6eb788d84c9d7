"""Packets of Live Link Face and OSC: what is read of good ones, and that bad ones are refused."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

import pytest

from myoface.live.faces import Face, Layout
from myoface.live.live_link import NAMES, read_packet
from myoface.live.osc import BUNDLE, LONGEST, OscMessage, read_osc, write_osc
from myoface.live.osc_faces import OscReader, write_face
from myoface.live.readings import Expected, Reading, ReadingError
from solver.scans.performance import ANGLES, ARKIT_NAMES
from tests.myoface.live.packets import live_link_packet


def test_a_packet_of_live_link_face_is_read() -> None:
    given = {"jawOpen": 0.5, "mouthLeft": 0.25, "rightEyeRoll": -0.125}

    reading = read_packet(live_link_packet(given, 120))

    assert reading is not None
    assert reading.seconds == pytest.approx(120.25 / 60)
    assert isinstance(reading.values, dict)
    assert {name: value for name, value in reading.values.items() if value} == given
    assert set(NAMES) == {*ARKIT_NAMES, *(name for names in ANGLES.values() for name in names)}


def test_a_packet_without_a_face_is_none() -> None:
    whole = live_link_packet({}, 1)
    without = whole[: -4 * len(NAMES) - 1] + b"\0"
    assert read_packet(without) is None


@pytest.mark.parametrize("rate", [0, -1, 1_000_000])
def test_a_packet_with_no_rate_is_refused(rate: int) -> None:
    with pytest.raises(ReadingError, match="no rate"):
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
    with pytest.raises(ReadingError, match="-4 bytes"):
        list(read_osc(BUNDLE + bytes(8) + struct.pack(">i", -4) + b"/abc"))


def test_bundles_within_bundles_end() -> None:
    packet = b"/a\0\0"
    for _ in range(2000):
        packet = BUNDLE + bytes(8) + struct.pack(">i", len(packet)) + packet
    with pytest.raises(ReadingError, match="deep"):
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
    assert reading.values == {"jawOpen": 0.5, "browInnerUp": 0.25}
    assert reader.read(b"/VMC/Ext/Blend/Apply\0\0\0\0,\0\0\0") is None  # nothing came since


def test_a_face_that_is_sent_can_be_read_as_a_frame() -> None:
    face = Face(
        7, 50_000.016, 1.5, (0.1, 0.2), 0, 0, (0.0,) * 16, (0.0,) * 5,
        {"jawOpen": 0.5}, {"zygomaticus major l": 0.125, "unknown": float("nan")},
    )  # fmt: skip
    packets = list(write_face(face))
    sent = {found.address: found.arguments for packet in packets for found in read_osc(packet)}
    assert sent["/myoface/contraction/zygomaticus_major_l"] == (0.125,)
    assert not [address for address in sent if "unknown" in address]

    reader = OscReader()
    readings = [reader.read(packet) for packet in packets]

    assert readings[-1] == Reading(50_000.016, {"jawOpen": 0.5})


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
        except ReadingError:
            refused += 1
    assert refused > 1000


def test_a_reading_becomes_rows_in_the_sessions_order() -> None:
    expected = Expected(3, 3, ("A", "B", "C"))

    numbers = expected.numbers(Reading(0.0, {"C": [7.0, 8.0, 9.0], "A": [1, 2, 3], "X": [0, 0, 0]}))

    found = struct.unpack("<9f", numbers)
    assert found[:3] + found[6:] == (1, 2, 3, 7, 8, 9)
    assert all(value != value for value in found[3:6])


@pytest.mark.parametrize(
    "values", [{"A": 1.0}, {"A": [1, 2]}, [[1, 2, 3]], {"A": "b"}, b"abc", {"A": [10**400, 0, 0]}]
)
def test_values_of_another_form_are_refused(values: object) -> None:
    with pytest.raises(ReadingError):
        Expected(2, 3, ("A", "B")).numbers(Reading(0.0, values))  # type: ignore[arg-type]


def test_a_layout_takes_a_frame_apart() -> None:
    ready = {
        "layout": [{"name": "head", "shape": [4, 4]}, {"name": "values", "shape": [2]}],
        "sliders": ["jawOpen", "cheekPuff"],
        "muscles": [],
    }
    layout = Layout.of(ready)

    arrays = layout.arrays(struct.pack("<18f", *range(18)))

    assert list(arrays["values"]) == [16, 17]
    with pytest.raises(ValueError, match="17 numbers"):
        layout.arrays(bytes(4 * 17))
