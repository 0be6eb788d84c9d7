"""`myoface live` with a service: the face is the numbers it is given."""

from __future__ import annotations

import io
import json
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from myoface.stack import Stack
from tests.command_line import Told, invoke
from tests.service_client import Studio, eventually, running


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Stack, Studio, str]]:
    with running(tmp_path_factory.mktemp("live"), live_workers=1) as (stack, studio):
        _, rig_id = studio.rigged()
        yield stack, studio, rig_id


def _run(stack: Stack, rig_id: str, *words: str) -> Told:
    env = {"MYOFACE_API_KEY": stack.key}
    return invoke(["live", rig_id[:8], "--url", stack.url, *words], env)


def test_lines_are_followed_and_the_take_is_stored(
    live: tuple[Stack, Studio, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stack, studio, rig_id = live
    lines = [json.dumps({"seconds": n / 60, "values": [n, 0.5, 1]}) for n in range(30)]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join([*lines, "no frame"])))

    told = _run(stack, rig_id, "--stdin", "--record", "walk")

    assert told.exit_code == 0, told.output
    assert "30 frames sent, 30 followed, 0 dropped" in told.stdout
    assert "1 faults, line 31: this is not JSON" in told.stdout
    assert "walk: walk.csv, 30 frames" in told.stdout
    session, *_ = studio.get(f"/v1/live?rig_id={rig_id}")["items"]
    assert f"{stack.url}/rigs/{rig_id}?live={session['id']}" in told.stdout
    job = studio.job(session["id"])
    assert (job["state"], job["result"]["summary"]["takes"]) == ("succeeded", ["walk"])


def test_a_session_that_is_ended_elsewhere_ends_the_station(
    live: tuple[Stack, Studio, str],
) -> None:
    stack, studio, rig_id = live
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def end() -> None:
        eventually(lambda: len(_open_sessions(studio, rig_id)) == 1)
        [session] = _open_sessions(studio, rig_id)
        time.sleep(0.5)
        studio.http.delete(f"/v1/live/{session['id']}")

    ending = threading.Thread(target=end)
    ending.start()
    told = _run(stack, rig_id, "--live-link", str(port), "--from", "127.0.0.1")
    ending.join()

    assert told.exit_code == 0, told.output
    assert "the session has ended" in told.stdout


def test_a_take_is_recorded_by_whoever_may_write(live: tuple[Stack, Studio, str]) -> None:
    from myoface.client import Client

    stack, studio, rig_id = live
    with Client(stack.url, stack.key) as client, client.live(rig_id) as face:
        path = f"/v1/live/{face.id}/recording"
        assert studio.http.put(path, json={"name": "scene"}).status_code == 202
        face.send([1, 2, 3])
        assert face.receive(5.0) is not None
        assert studio.http.delete(path).status_code == 202
        face.send([1, 2, 3])
        assert face.receive(5.0) is not None
        assert [take["name"] for take in face.takes] == ["scene"]
        assert face.receive(0.1) is None
    answer = studio.http.put(path, json={"name": "late"})
    assert (answer.status_code, answer.json()["code"]) == (409, "live.over")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give one of --live-link, --osc, --stdin and --replay"),
        (["--stdin", "--osc", "9000"], "give one of"),
        (["--stdin", "--from", "10.0.0.1"], "--from is for"),
        (["--osc", "9000", "--from", "phone"], "it is no address"),
        (["--stdin", "--to-osc", "9000"], "no HOST:PORT"),
        (["--stdin", "--record", "a take"], "no name of a take"),
        (["--live-link", "9000", "--source", "markers"], "sends weights"),
    ],
)
def test_words_that_make_no_session_are_refused(words: list[str], message: str) -> None:
    told = invoke(["live", "rig", *words])
    assert told.exit_code == 2
    assert message in told.stderr


def _open_sessions(studio: Studio, rig_id: str) -> Any:
    return studio.get(f"/v1/live?rig_id={rig_id}&state=running")["items"]
