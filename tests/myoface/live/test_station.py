"""A station from its UDP port, lines or a file to the session and on, over real sockets."""

from __future__ import annotations

import io
import json
import math
import socket
import struct
from array import array
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import anyio
import numpy as np
import pytest

from myoface.cli.live import MOST_RATE, TAKE, USUAL_RATE
from myoface.cli.live import Source as StationSource
from myoface.client import ClientOptions, LiveFrame, Timed
from myoface.client.aio_live import FOR_GOOD, AsyncLiveFace
from myoface.client.live_frames import read_frame
from myoface.errors import UNREACHABLE, ApiError
from myoface.live.datagrams import PacketError, Port
from myoface.live.lines import read_line, tell_frame
from myoface.live.live_link import read_packet
from myoface.live.osc import OscMessage, read_osc
from myoface.live.replay import Replay, play
from myoface.live.sinks import LineSink, OscSink
from myoface.live.station import Given, Station, Tally
from service.live import relay
from solver.errors import InputError
from solver.kinds.live_messages import GAP, HELD, FollowedFrame
from solver.kinds.live_session import LiveSessionOptions, Source
from solver.live import takes
from solver.live.texts import describe_frame
from tests.myoface.live.echo import READY, EchoLine, EchoSocket, echo_face
from tests.myoface.live.packets import live_link_packet


async def run(station: Station, socket: EchoSocket, source: AsyncIterator[Given]) -> Tally:
    """Run a station with an echo."""
    with anyio.fail_after(20):
        return await station.run(await echo_face(socket, station.said), source)


async def listed(readings: list[Any]) -> AsyncIterator[Any]:
    for reading in readings:
        yield reading


def test_packets_of_the_allowed_address_become_faces_and_others_are_counted() -> None:
    lines = io.StringIO()
    port = Port(0, read_packet, "127.0.0.1")

    async def run_with_senders() -> Tally:
        station = Station([LineSink(lines)])
        async with anyio.create_task_group() as tasks:
            source = port.frames(lambda: tasks.start_soon(_send_all, port))
            tally = await run(station, EchoSocket(most=20), source)
            tasks.cancel_scope.cancel()
        return tally

    tally = anyio.run(run_with_senders)

    assert tally.ended == "idle"
    said = [json.loads(line) for line in lines.getvalue().splitlines()]
    assert [each["type"] for each in said] == ["ready", *(["frame"] * 20), "ended"]
    assert all(each["weights"]["jawOpen"] < 0.5 for each in said[1:-1])
    assert port.counts.garbage > 10
    assert port.counts.foreign > 10
    assert port.counts.good >= 20


async def _send_all(port: Port) -> None:
    """Send what a phone does, garbage, and what a stranger does, who is believed nothing."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        stranger.bind(("127.0.0.2", 0))
        phone.settimeout(0.0)
        to = ("127.0.0.1", port.number)
        for frame in range(1000):
            phone.sendto(live_link_packet({"jawOpen": frame / 10_000}, frame), to)
            phone.sendto(b"garbage", to)
            stranger.sendto(live_link_packet({"jawOpen": 1.0}, frame), to)
            await anyio.sleep(0.005)
            with pytest.raises(BlockingIOError):
                phone.recv(1)  # nothing is ever answered


def test_without_an_address_the_first_good_packet_says_whose_the_port_is() -> None:
    port = Port(0, read_packet)
    good = live_link_packet({}, 1)

    assert port._read(b"garbage", "10.0.0.9") is None
    assert port._read(good, "10.0.0.1") is not None
    assert port._read(good, "10.0.0.2") is None

    assert (port.counts.good, port.counts.garbage, port.counts.foreign) == (1, 1, 1)


def test_a_slow_session_gets_the_newest_frame() -> None:
    async def quick() -> AsyncIterator[Timed]:
        for number in range(100):
            yield Timed(number / 1000, {"jawOpen": number / 100})
            await anyio.sleep(0.001)

    async def run_slow() -> tuple[Tally, EchoSocket]:
        echo = EchoSocket(delay_s=0.05)
        return await run(Station([]), echo, quick()), echo

    tally, echo = anyio.run(run_slow)

    assert tally.sent + tally.dropped_here == 100
    assert 2 <= tally.sent < 30
    assert tally.followed == tally.sent
    assert tally.dropped == 3
    assert echo.frames[-1].seconds == 0.099


def test_lines_are_all_sent_and_a_take_is_recorded() -> None:
    given = [Timed(number / 60, {"jawOpen": 0.5}) for number in range(50)]

    async def run_lines() -> tuple[Tally, EchoSocket]:
        echo = EchoSocket()
        station = Station([], record="take 1", waits=True)
        return await run(station, echo, listed([*given, Timed(1.0, {"jawOpen": "wide"})])), echo

    tally, echo = anyio.run(run_lines)

    assert (tally.sent, tally.refused) == (50, 1)
    assert tally.first_fault is not None
    assert echo.wishes == [{"record": "take 1"}, {"stop": True}]
    assert [take["frames"] for take in tally.takes] == [50]
    assert tally.latency_ms(0.95) < 1000


def test_a_station_that_is_stopped_keeps_its_take() -> None:
    async def endless() -> AsyncIterator[Timed]:
        yield Timed(0.0, {"jawOpen": 0.5})
        await anyio.sleep_forever()

    async def run_and_stop() -> Tally:
        station = Station([], record="take 1")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run, station, EchoSocket(), endless())
            while not station.tally.followed:
                await anyio.sleep(0.01)
            station.stop()
        return station.tally

    assert anyio.run(run_and_stop).takes


def test_what_the_source_raises_comes_as_it_is() -> None:
    async def broken() -> AsyncIterator[Timed]:
        yield Timed(0.0, {"jawOpen": 0.5})
        raise OSError("the port is taken")

    with pytest.raises(OSError, match="the port is taken"):
        anyio.run(lambda: run(Station([]), EchoSocket(), broken()))


def frame(number: int = 7, is_held: bool = False) -> LiveFrame:
    arrays = {name: array("f", [0.0] * size) for name, size in (("head", 16), ("jaw", 5))}
    arrays |= {"values": array("f", [0.5, 0.0]), "contractions": array("f", [0.25])}
    return LiveFrame(number, 0.5, 1.0, 0.1, 0.2, 0, is_held, False, False, arrays)


def test_faces_come_out_as_osc() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        sink = OscSink("127.0.0.1", receiver.getsockname()[1])
        sink.said(READY)
        sink.face(frame(is_held=True), 3.0)
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
    sink.said(READY)
    for number in range(3):
        sink.face(frame(number), None)
    sink.close()


def test_the_station_knows_what_a_session_does() -> None:
    rate = LiveSessionOptions.model_json_schema()["properties"]["rate"]
    assert (rate["default"], rate["maximum"]) == (USUAL_RATE, MOST_RATE)
    assert set(get_args(StationSource)) == set(get_args(Source))
    assert TAKE.pattern == takes.NAME.pattern
    closed = (relay.ENDED, relay.TOO_LARGE, relay.TAKEN_OVER, relay.REVOKED)
    assert sorted(FOR_GOOD) == sorted(closed)


def test_a_line_says_a_frame_as_the_session_does_in_text() -> None:
    arrays = {"head": range(16), "jaw": range(5), "values": (0.5, 0.25), "contractions": [0.125]}
    shapes = {each["name"]: tuple(each["shape"]) for each in READY["layout"]}
    names = SimpleNamespace(names=READY["sliders"])
    rig = SimpleNamespace(model=SimpleNamespace(muscle_names=READY["muscles"]))
    session: Any = SimpleNamespace(
        layout=tuple((name, shapes[name]) for name in arrays),
        face=SimpleNamespace(skin=names, rig=rig),
    )
    numbers = b"".join(array("f", each).tobytes() for each in arrays.values())
    sent = FollowedFrame(7, 0.5, 1.5, math.nan, 0.25, 2, HELD | GAP, numbers)
    layout = [{"name": name, "shape": shape} for name, shape in session.layout]

    line = tell_frame(read_frame(sent.pack(), layout), READY, 3.0)

    assert line.pop("latency_ms") == 3.0
    assert line == describe_frame(sent, session)


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
    with pytest.raises(PacketError, match=message):
        read_line(line)


def test_lines_are_frames_or_controls() -> None:
    assert read_line('{"number": 7, "seconds": 0.1, "weights": {"jawOpen": 0.3}}') == Timed(
        0.1, {"jawOpen": 0.3}
    )
    assert read_line('{"seconds": 0.1, "values": [[1, 2, 3], null]}') == Timed(
        0.1, [[1, 2, 3], None]
    )
    assert read_line('{"record": "take 1"}') == {"record": "take 1"}


def test_a_recording_of_live_link_face_is_played_at_its_rate(tmp_path: Path) -> None:
    from solver.scans.live_link import FaceTake, write_signals

    times = np.arange(6) / 30
    weights = np.linspace(0, 1, 6)[:, None] * np.ones(52)
    still = np.zeros((6, 3))
    take = FaceTake(times, weights, still, np.zeros((6, 2, 3)), np.ones(6, bool), "video")
    write_signals(tmp_path / "take.csv", take)

    async def run_replay(replay: Replay) -> list[tuple[float, Timed]]:
        return [(anyio.current_time(), frame) async for frame in play(replay.frames)]

    replay = Replay.open(tmp_path / "take.csv", 60.0)
    played = anyio.run(run_replay, replay)

    assert (replay.source, round(replay.rate)) == ("weights", 30)
    assert [frame.numbers["jawOpen"] for _, frame in played] == pytest.approx(weights[:, 0])  # type: ignore[call-overload]
    moments = np.array([moment for moment, _ in played])
    assert moments - moments[0] == pytest.approx(times, abs=0.05)


def test_a_performance_is_played_as_points(tmp_path: Path) -> None:
    np.save(tmp_path / "take.npy", np.arange(12.0).reshape(2, 2, 3))

    replay = Replay.open(tmp_path / "take.npy", 25.0)
    frames = list(replay.frames)

    assert (replay.source, replay.rate) == ("points", 25.0)
    assert frames[1] == Timed(0.04, struct.pack("<6f", *range(6, 12)))


@pytest.mark.parametrize("given", [b"no array", np.zeros((4, 3)), np.zeros((2, 2, 3), bool)])
def test_what_is_no_performance_is_refused_by_name(given: Any, tmp_path: Path) -> None:
    file = tmp_path / "take.npy"
    if isinstance(given, bytes):
        file.write_bytes(given)
    else:
        np.save(file, given)
    with pytest.raises(InputError, match=r"take\.npy has no frames of points"):
        Replay.open(file, 25.0)


class BrokenSocket(EchoSocket):
    """A line on which nothing can be said any more."""

    async def send(self, message: bytes | str) -> None:
        raise ApiError({"code": UNREACHABLE, "detail": "the line broke"})


def test_a_wish_is_said_again_where_the_line_broke() -> None:
    async def record() -> list[dict[str, Any]]:
        mended = EchoSocket()
        face = AsyncLiveFace("echo", EchoLine(mended), ClientOptions(), lambda words: None)
        await face.open(BrokenSocket())
        await face.record("one")
        return mended.wishes

    assert anyio.run(record) == [{"record": "one"}]
