"""A station from its UDP port, lines or a file to the session and on, over real sockets."""

from __future__ import annotations

import io
import json
import socket
import struct
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from myoface.live.datagrams import Port
from myoface.live.faces import Face
from myoface.live.lines import read_line
from myoface.live.live_link import read_packet
from myoface.live.osc import OscMessage, read_osc
from myoface.live.readings import Reading, ReadingError
from myoface.live.replay import Replay, play
from myoface.live.sinks import LineSink, OscSink
from myoface.live.station import Station, StationOptions
from tests.myoface.live.packets import live_link_packet

NAMES = ("jawOpen", "mouthLeft")
READY = {
    "type": "ready",
    "expects": {"rows": 2, "width": 1, "labels": list(NAMES)},
    "layout": [],
    "sliders": list(NAMES),
    "muscles": [],
}


class Echo:
    """A session whose faces have the weights that were sent, after ``delay_s``."""

    def __init__(self, delay_s: float = 0.0, most: int | None = None) -> None:
        self.controls: list[Mapping[str, Any]] = []
        self.delay_s = delay_s
        self.most = most  # frames after which it ends by itself
        self.sent = 0
        self._out, self._in = anyio.create_memory_object_stream[Face | dict[str, Any]](1000)

    async def send(self, number: int, seconds: float, numbers: bytes) -> None:
        await anyio.sleep(self.delay_s)
        self.sent += 1
        values = dict(zip(NAMES, struct.unpack("<2f", numbers), strict=True))
        about = (number, seconds, 1.0, (0.1, 0.2), 3, 0)
        await self._out.send(Face(*about, (0.0,) * 16, (0.0,) * 5, values, {}))
        if self.sent == self.most:
            await self._out.send({"type": "ended", "reason": "idle"})

    async def control(self, said: Mapping[str, Any]) -> None:
        self.controls.append(said)
        if "stop" in said:
            take = {"type": "take", "name": "take 1", "file": "take_1.csv", "frames": self.sent}
            await self._out.send(take)
        if "end" in said:
            await self._out.send({"type": "ended", "reason": "asked"})

    async def received(self) -> AsyncIterator[Face | dict[str, Any]]:
        yield READY
        async for message in self._in:
            yield message


async def listed(readings: list[Any]) -> AsyncIterator[Any]:
    for reading in readings:
        yield reading


def test_packets_of_the_allowed_address_become_faces_and_others_are_counted() -> None:
    lines = io.StringIO()
    port = Port(0, read_packet, "127.0.0.1")
    echo = Echo(most=20)

    async def run() -> Station:
        station = Station(echo, [LineSink(lines)])

        async def send() -> None:
            with (
                socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone,
                socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
            ):
                stranger.bind(("127.0.0.2", 0))
                phone.settimeout(0.0)
                to = ("127.0.0.1", port.number)
                for frame in range(1000):
                    phone.sendto(live_link_packet({"jawOpen": frame / 1000}, frame), to)
                    phone.sendto(b"garbage", to)
                    stranger.sendto(live_link_packet({"jawOpen": 1.0}, frame), to)
                    await anyio.sleep(0.005)
                    with pytest.raises(BlockingIOError):
                        phone.recv(1)  # nothing is ever answered

        with anyio.fail_after(20):
            async with anyio.create_task_group() as tasks:
                source = port.readings(lambda: tasks.start_soon(send))
                await station.run(source)
                tasks.cancel_scope.cancel()
        return station

    station = anyio.run(run)

    assert station.tally.ended == "idle"
    faces = [
        said for said in map(json.loads, lines.getvalue().splitlines()) if said["type"] == "frame"
    ]
    assert len(faces) == 20
    assert all(face["values"]["jawOpen"] < 0.5 for face in faces)
    assert port.counts.garbage > 10
    assert port.counts.foreign > 10
    assert port.counts.good >= 20


def test_without_an_address_the_first_good_packet_says_whose_the_port_is() -> None:
    port = Port(0, read_packet)
    good = live_link_packet({}, 1)

    assert port._read(b"garbage", "10.0.0.9") is None
    assert port._read(good, "10.0.0.1") is not None
    assert port._read(good, "10.0.0.2") is None

    assert (port.counts.good, port.counts.garbage, port.counts.foreign) == (1, 1, 1)


def test_a_slow_session_gets_the_newest_frame() -> None:
    echo = Echo(delay_s=0.05)

    async def quick() -> AsyncIterator[Reading]:
        for number in range(100):
            yield Reading(number / 1000, {"jawOpen": number / 100})
            await anyio.sleep(0.001)

    async def run() -> Station:
        station = Station(echo, [])
        await station.run(quick())
        return station

    tally = anyio.run(run).tally

    assert tally.sent + tally.dropped_here == 100
    assert 2 <= tally.sent < 30
    assert tally.followed == tally.sent
    assert tally.dropped == 3


def test_lines_are_all_sent_and_a_take_is_recorded() -> None:
    echo = Echo()
    given = [Reading(number / 60, {"jawOpen": 0.5}) for number in range(50)]

    async def run() -> Station:
        station = Station(echo, [], record="take 1", waits=True)
        await station.run(listed([*given, Reading(1.0, [0.5])]))
        return station

    tally = anyio.run(run).tally

    assert (tally.sent, tally.refused, tally.first_refusal) == (
        50,
        1,
        "a frame has 1 rows, and 2 are expected",
    )
    assert echo.controls == [{"record": "take 1"}, {"stop": True}, {"end": True}]
    assert [take["frames"] for take in tally.takes] == [50]
    assert tally.latency_ms(0.95, StationOptions()) is not None


def test_a_station_that_is_stopped_keeps_its_take() -> None:
    echo = Echo()

    async def endless() -> AsyncIterator[Reading]:
        yield Reading(0.0, {"jawOpen": 0.5})
        await anyio.sleep_forever()

    async def run() -> Station:
        station = Station(echo, [], record="take 1")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(station.run, endless())
            while not station.tally.followed:
                await anyio.sleep(0.01)
            station.stop()
        return station

    with_take = anyio.run(run).tally

    assert with_take.takes
    assert with_take.ended == "asked"


def test_faces_come_out_as_osc() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        sink = OscSink("127.0.0.1", receiver.getsockname()[1])
        sink.face(
            Face(7, 0.5, 1.0, (0.1, 0.2), 0, 1, (1.0,) * 16, (2.0,) * 5, {"jawOpen": 0.5}, {}), 3.0
        )
        found = list(read_osc(receiver.recv(2048)))
        sink.close()

    assert OscMessage("/myoface/value/jawOpen", (0.5,)) in found
    assert found[-1].address == "/myoface/frame"
    assert found[-1].arguments[-1] == 1  # held


def test_nobody_at_the_other_end_of_osc_is_no_fault() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    sink = OscSink("127.0.0.1", number)
    for frame in range(3):
        sink.face(Face(frame, 0.5, 1.0, (0.1, 0.2), 0, 0, (1.0,) * 16, (2.0,) * 5, {}, {}), None)
    sink.close()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "not JSON"),
        ("[1]", "an object"),
        ('{"seconds": 1}', "weights by name"),
        ('{"weights": {}, "seconds": "now"}', "seconds is a number"),
        ('{"record": 7}', "record is a control"),
        ("[" * 100_000, "not JSON"),
    ],
)
def test_lines_that_are_no_frames_are_refused(line: str, message: str) -> None:
    with pytest.raises(ReadingError, match=message):
        read_line(line)


def test_lines_are_frames_or_controls() -> None:
    assert read_line('{"number": 7, "seconds": 0.1, "weights": {"jawOpen": 0.3}}') == Reading(
        0.1, {"jawOpen": 0.3}
    )
    assert read_line('{"seconds": 0.1, "values": [[1, 2, 3], null]}') == Reading(
        0.1, [[1, 2, 3], None]
    )
    assert read_line('{"record": "take 1"}') == {"record": "take 1"}


def test_a_recording_of_live_link_face_is_played_at_its_rate(tmp_path: Path) -> None:
    from solver.scans.performance import FaceTake, write_signals

    times = np.arange(6) / 30
    weights = np.linspace(0, 1, 6)[:, None] * np.ones(52)
    still = np.zeros((6, 3))
    take = FaceTake(times, weights, still, np.zeros((6, 2, 3)), np.ones(6, bool), "video")
    write_signals(tmp_path / "take.csv", take)

    async def run(replay: Replay) -> list[tuple[float, Reading]]:
        return [(anyio.current_time(), reading) async for reading in play(replay.frames)]

    replay = Replay.open(tmp_path / "take.csv")
    played = anyio.run(run, replay)

    assert (replay.source, round(replay.rate)) == ("weights", 30)
    assert [reading.values["jawOpen"] for _, reading in played] == pytest.approx(weights[:, 0])  # type: ignore[call-overload]
    moments = np.array([moment for moment, _ in played])
    assert moments - moments[0] == pytest.approx(times, abs=0.05)


def test_a_performance_is_played_as_points(tmp_path: Path) -> None:
    np.save(tmp_path / "take.npy", np.arange(12.0).reshape(2, 2, 3))

    replay = Replay.open(tmp_path / "take.npy", 25.0)
    frames = list(replay.frames)

    assert (replay.source, replay.rate) == ("points", 25.0)
    assert frames[1] == Reading(0.04, struct.pack("<6f", *range(6, 12)))
