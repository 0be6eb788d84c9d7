"""A session as its job holds it: messages in and out, clocks, faults, takes and full solves."""

import json
import shutil
import time

import numpy as np
import pytest

from solver.errors import InputError
from solver.jobs import run_job
from solver.kinds.live_channel import ChannelClosedError
from solver.kinds.live_messages import GAP, HELD, RESUMED, GivenFrame, Message
from solver.kinds.live_session import PART, REPORT
from solver.live.sent import FILE as TAKES_FILE
from solver.live.sent import read_takes
from solver.live.session import Counts, LiveOptions, LiveSession, RunningError
from solver.live.takes import SentFace, TakeWriter
from solver.live.weights import LiveWeights
from solver.scans.live_link import ARKIT_NAMES, read_live_link
from tests.solver.live.live_client import OPEN, Client
from tests.solver.live.live_rig import follow, live_files

JAW_OPEN = ARKIT_NAMES.index("jawOpen")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return live_files(tmp_path_factory.mktemp("rig"))


def test_a_session_is_held_recorded_and_reported(files, tmp_path):
    client = Client(files, tmp_path)
    ready = client.hear("ready")
    assert ready["expects"]["rows"] == 61
    sizes = {each["name"]: int(np.prod(each["shape"])) for each in ready["layout"]}
    client.say(record="smile")
    assert client.hear("recording")["name"] == "smile"
    for number in range(5):
        weights = OPEN.copy()
        weights[JAW_OPEN] = 0.1 * number
        client.frame(number, 1.0 + number / 60, weights)
        found = client.followed()
        assert (found.number, found.flags) == (number, 0)
        assert len(found.numbers) == 4 * sum(sizes.values())
    client.say(number=5, seconds=1.1, weights={"JawOpen": 0.5, "eyeBlinkLeft": None})
    said = client.hear("frame")
    assert said["weights"]["jawOpen"] == pytest.approx(0.5)
    assert said["error_p50_mm"] is None
    client.say(stop=True)
    assert client.hear("take")["frames"] == 6
    client.say(end=True)
    assert client.hear("ended")["reason"] == "asked"
    client.thread.join()
    names = {path.name for path in client.left}
    made = {"live.json", "live_skin.npz", "live_view.bin", "take_smile.csv", TAKES_FILE}
    assert made <= names
    assert len(read_live_link(tmp_path / "take_smile.csv").times) == 6
    report = json.loads((tmp_path / "live.json").read_text())
    assert report["frames"] == 6
    assert report["takes"][0]["file"] == "take_smile.csv"
    assert report["solve_ms"]["p99"] < 1000


def test_bad_messages_are_told_and_the_session_goes_on(files, tmp_path):
    client = Client(files, tmp_path)
    client.hear("ready")
    client.frame(1, 0.0, np.zeros(7, "<f4"))
    assert client.hear("fault")["code"] == "live.frame"
    for data in (b"MYF>", b"garbage", b""):
        client.channel.send(Message(data))
    assert client.hear("fault")["code"] == "live.message"
    client.say(record="../x")
    assert client.hear("fault")["code"] == "live.take_name"
    client.say(number=-1, seconds=0, weights={})
    client.say(number=1, seconds=0, weights={"noName": 1})
    client.say(number=1, seconds=0, values=[[0, 0, 0]])
    client.channel.send(Message(b"[" * 100_000, is_text=True))
    client.frame(2, 0.0, np.full(61, np.nan, "<f4"))
    assert client.followed().flags == HELD
    client.frame(3, 0.0, np.full(61, np.inf, "<f4"))
    assert client.followed().flags == HELD
    client.channel.close()
    client.thread.join()
    report = json.loads((tmp_path / "live.json").read_text())
    assert report["ended"] == "closed"
    assert report["faults"]["live.message"] == 7


def test_clocks_that_jump_begin_anew_and_frames_too_fast_are_dropped(files, tmp_path):
    session = LiveSession.open(files, tmp_path, LiveOptions("weights", check_seconds=0))
    flags = [
        follow(session, GivenFrame(number, seconds, OPEN.tobytes())).flags
        for number, seconds in enumerate([0.0, 0.1, 0.1, 0.05, 0.06, 9.0, 9.5])
    ]
    assert flags == [0, 0, 0, GAP, 0, GAP, 0]
    with pytest.raises(InputError) as caught:
        session.read(GivenFrame(9, float("nan"), OPEN.tobytes()))
    assert caught.value.code == "live.frame"
    client = Client(files, tmp_path)
    client.hear("ready")
    for number in range(200):
        client.frame(number, number / 1e4)
    client.say(end=True)
    last = [client.followed() for _ in range(1)][-1]
    while not isinstance(found := client.hear(), dict):
        last = found
    client.thread.join()
    report = json.loads((tmp_path / "live.json").read_text())
    assert report["dropped"] > 0
    assert report["frames"] + report["dropped"] == 200
    assert last.number == 199


def test_a_frame_that_cannot_be_followed_costs_neither_session_nor_take(
    files, tmp_path, monkeypatch
):
    plain = LiveWeights.step

    def step(source, numbers, seconds):
        if numbers[0, 0] > 0.9:
            raise np.linalg.LinAlgError("SVD did not converge")
        return plain(source, numbers, seconds)

    monkeypatch.setattr(LiveWeights, "step", step)
    client = Client(files, tmp_path)
    client.hear("ready")
    client.say(stop=True)  # of a take that nobody began
    assert client.hear("take") == {
        "type": "take",
        "name": None,
        "file": None,
        "frames": 0,
        "seconds": 0.0,
    }
    client.say(record="walk")
    client.hear("recording")
    for number in range(3):
        client.frame(number, number / 60, np.full(61, float(number == 1), "<f4"))
        if number == 1:
            fault = client.hear("fault")
            assert (fault["code"], fault["number"]) == ("live.frame", 1)
            assert "SVD" in fault["message"]
        else:
            assert client.followed().number == number
    client.say(end=True)
    assert client.hear("take")["frames"] == 3
    client.thread.join()


def test_faults_of_text_name_their_frame(files, tmp_path):
    client = Client(files, tmp_path)
    client.hear("ready")
    client.say(number=7, seconds=10**400, values=[])
    fault = client.hear("fault")
    assert (fault["code"], fault["number"]) == ("live.message", 7)
    client.say(end=True)
    client.hear("ended")
    client.thread.join()


def test_another_attempt_goes_on_from_the_last_frame(files, tmp_path):
    session = LiveSession.open(files, tmp_path, LiveOptions("weights", check_seconds=0))
    weights = OPEN.copy()
    weights[JAW_OPEN] = 0.8
    last = follow(session, GivenFrame(4, 1.0, weights.tobytes()), dropped=3)
    client = Client(files, tmp_path)
    client.say(resume=True)
    client.channel.send(Message(last.pack()))
    client.hear("ready")
    client.frame(5, 1.2, np.full(61, np.nan, "<f4"))
    found = client.followed()
    assert found.flags == RESUMED | HELD
    assert found.dropped == 3
    values = np.frombuffer(last.numbers, "<f4")[21:73]
    expected = np.exp(-0.2) * values
    np.testing.assert_allclose(np.frombuffer(found.numbers, "<f4")[21:73], expected, atol=1e-5)
    client.channel.send(Message(last.pack()))
    assert client.hear("fault")["code"] == "live.message"
    client.say(end=True)
    client.thread.join()


def test_another_attempt_lists_the_takes_of_one_that_was_killed(files, tmp_path):
    """One was listed, one whole but not yet listed, and one was being recorded."""
    first = Client(files, tmp_path / "first")
    first.say(record="listed")
    first.hear("recording")
    first.frame(1, 0.0)
    first.say(stop=True)
    first.hear("take")
    out = tmp_path / "second"
    shutil.copytree(tmp_path / "first", out)  # as the kill leaves it
    first.say(end=True)
    first.thread.join()
    session = LiveSession.open(files, out, LiveOptions("weights", check_seconds=0))
    about = ("weights", session.source.labels, (61, 1), session.modes)
    whole = TakeWriter(out, "whole", *about)
    whole.add(0.0, np.zeros((61, 1)), SentFace(np.ones(len(session.modes.basis)), (0.1, 0.2)))
    whole.finish()
    torn = TakeWriter(out, "torn", *about)
    for number in range(3):
        sent = SentFace(np.full(len(session.modes.basis), number), (0.1, 0.2 * number))
        torn.add(number / 60, np.zeros((61, 1)), sent)
    client = Client(files, out, resume=True)
    assert {client.hear("take")["name"] for _ in range(2)} == {"torn", "whole"}
    client.hear("ready")
    client.say(end=True)
    client.thread.join()
    takes = json.loads((out / REPORT).read_text())["takes"]
    assert [each["name"] for each in takes] == ["listed", "torn", "whole"]
    assert "rescued" not in takes[0]
    assert not list(out.glob(f"*{PART}"))
    assert {out / TAKES_FILE, *(out / each["file"] for each in takes)} <= {*client.left}
    _, sent = read_takes(out / TAKES_FILE)
    found = {each.name: each for each in sent}
    assert {*found} == {"listed", "whole", "torn"}
    assert found["torn"].frames.tolist() == [0, 1, 2]
    assert found["torn"].amounts[:, -1].tolist() == [0, 1, 2]
    assert found["torn"].told == {"p50_mm": 0.1, "p95_mm": 0.4}


def test_a_session_without_frames_ends(files, tmp_path):
    client = Client(files, tmp_path, idle_seconds=1)
    assert client.hear("ended")["reason"] == "idle"
    client.thread.join()
    client.channel.close()
    with pytest.raises(ChannelClosedError):
        client.say(end=True)


def test_a_session_needs_a_channel(files, tmp_path):
    with pytest.raises(InputError) as caught:
        run_job("live_session", tmp_path, **files)
    assert caught.value.code == "live.channel"


@pytest.mark.long
def test_full_solves_measure_the_error_and_mend_it(files, tmp_path):
    """The reduced skin opens the mouth otherwise than the jaw does: that is seen, and learned."""
    session = LiveSession.open(
        files, tmp_path, LiveOptions("weights", check_seconds=0.01, window_s=1e3)
    )
    told = []
    try:
        begin = time.monotonic()
        number = 0
        while session.errors.solved < 4 and time.monotonic() < begin + 240:
            weights = OPEN.copy()
            weights[JAW_OPEN] = 0.4
            frame = follow(session, GivenFrame(number, number / 60, weights.tobytes()))
            told.append(frame.error_p50_mm)
            number += 1
            time.sleep(0.01)
    finally:
        session.close()
    assert session.errors.solved >= 4
    errors = [error for _, error, _ in session.errors._recent]
    assert errors[0] > 0.2
    assert errors[-1] < 0.7 * errors[0]
    assert np.isnan(told[0])
    assert np.isfinite(told[-1])
    assert not session._checks._process.is_alive()


def test_counts_have_the_percentiles_of_what_was_counted():
    counts = Counts(0.01, 1000)
    for value in np.linspace(0.0, 5.0, 1001):
        counts.add(value)
    figures = counts.figures((50, 95))
    assert figures["p50"] == pytest.approx(2.5, abs=0.02)
    assert figures["p95"] == pytest.approx(4.75, abs=0.02)
    assert Counts(1.0, 3).figures((50,)) == {"mean": None, "p50": None}


def test_a_frame_counts_by_the_time_that_it_stands_for():
    errors = RunningError(10.0)
    for number in range(8):
        errors.add(0.1, 0.1 * number)
    for number in range(3):
        errors.add(0.5, 2.0 + 2.0 * number)
    assert errors.told[0] == pytest.approx(0.5)
    errors.add(0.2, 30.0)
    assert errors.told == (0.2, 0.2)
    errors.add(None, 31.0)
    assert errors.figures()["failed"] == 1
