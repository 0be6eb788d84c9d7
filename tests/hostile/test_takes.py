"""Recordings from strangers, tables and videos, through the API and the real solver."""

from __future__ import annotations

import json
import os
import random
import socket
from pathlib import Path

import httpx
import pytest

from myoface.stack import Stack
from service.settings import Settings
from tests.campaigns.fuzz import seeds
from tests.campaigns.fuzz.mutations import LARGEST, NUMBER, NUMBERS, WORDS
from tests.fixtures import MEDIAPIPE_FOLDER, face_landmarker
from tests.hostile.test_necks import API_MB, SECRET, SOLVER_MB, memory_mb
from tests.kills.test_killed_simulation import fitted, with_bumps
from tests.service_client import QUICK, ROOT, Studio, eventually
from tests.solver.block import head_block

FILES = 300
PLAYED = {"controls": "blended"}
REFUSED = ("recording.", "live_link.", "openface.", "video.")


def spoilt(contents: list[bytes], seed: int) -> bytes:
    """Return one of some files with a few things done to it that nobody would."""
    dice = random.Random(seed)
    content = dice.choice(contents)
    for _ in range(dice.randint(1, 4)):
        place = dice.randrange(len(content) + 1)
        end = place + dice.choice([1, 4, 16, 64, 512])
        match dice.randrange(6):
            case 0 if found := list(NUMBER.finditer(content[:4096])):
                start, end = dice.choice(found).span()
                content = content[:start] + dice.choice(NUMBERS) + content[end:]
            case 1:
                word = dice.choice(WORDS)
                content = content[:place] + word + content[place + len(word) :]
            case 2:
                content = content[:place] + content[end:]
            case 3:
                content = content[:end] + content[place:end] * dice.choice([1, 300])
            case 4:
                content = content[:place]
            case _:
                other = dice.choice(contents)
                content = content[:place] + other[dice.randrange(len(other)) :]
        content = content[:LARGEST]
    return content or b"\0"


def hostile(folder: Path, address: str) -> dict[str, bytes]:
    """Return files by name that somebody meant: none of them is a recording."""
    (folder / "secret").write_text(SECRET)
    lists = {
        "list.csv": f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{address}\n",
        "list.mp4": f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{address}\n",
        "concat.mov": f"ffconcat version 1.0\nfile '{folder / 'secret'}'\n",
        "concat.csv": f"ffconcat version 1.0\nfile '{address}'\n",
        "address.mp4": address,
    }
    film = seeds.films()[0]
    headless = {"cut.mp4": film[: len(film) // 2], "head.mov": film[:64]}
    return {**{name: text.encode() for name, text in lists.items()}, **headless}


@pytest.mark.slow
def test_takes_that_nobody_would_record_are_refused_and_cost_the_service_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(MEDIAPIPE_FOLDER)]))
    if MEDIAPIPE_FOLDER.is_dir():  # else no video is looked at
        monkeypatch.setenv("MYOFACE_FACE_LANDMARKER", str(face_landmarker()))
    settings = Settings(data_dir=tmp_path / "data", solver_memory_mb=SOLVER_MB, **QUICK)
    model = head_block((7, 5, 1))
    template = with_bumps(tmp_path / "template.npz", model)
    subject, rig = fitted(settings, tmp_path, model, template)
    tables = [*seeds.live_link(), *seeds.openface(), *seeds.signals()]
    films = seeds.films()
    statuses = set[int]()
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        Stack(settings) as stack,
        httpx.Client(base_url=stack.url, timeout=60) as http,
    ):
        server.settimeout(0.2)
        meant = hostile(tmp_path, f"http://127.0.0.1:{server.getsockname()[1]}/film.mp4")
        files = {"good.csv": tables[0], **meant}
        for number in range(FILES - len(files)):
            kind, contents = ("mp4", films) if number % 5 == 0 else ("csv", tables)
            files[f"spoilt{number}.{kind}"] = spoilt(contents, number)
        http.event_hooks["response"].append(lambda answer: statuses.add(answer.status_code))
        studio = Studio(http, stack.key)

        def play(file: str, content: bytes) -> str:
            name = file.replace(".", "_")
            path = f"/v1/subjects/{subject}/captures"
            sent = studio.upload(file, content)
            asset = studio.post(path, name=name, role="asset", upload_id=sent)["id"]
            scene = {**PLAYED, "recording": {"asset": name}}
            how = {"rig_id": rig, "captures": [asset], "options": {"scene": scene}}
            return studio.submit("animate", subject, **how)

        # the first one solves the blendshapes that the others begin with
        first = studio.finished(play("first.csv", tables[0]), seconds=600)
        before = memory_mb(stack.pid("api"))
        jobs = {name: play(name, content) for name, content in files.items()}
        ended = {name: studio.finished(job, seconds=3600) for name, job in jobs.items()}
        assert memory_mb(stack.pid("api")) < before + API_MB
        eventually(lambda: not studio.solvers(stack))
        with pytest.raises(TimeoutError):
            server.accept()
        logs = [path.read_text() for path in settings.data_dir.rglob("*.log")]
    codes = {name: (done["error"] or {}).get("code") for name, done in ended.items()}
    assert first["state"] == "succeeded", first["error"]
    assert max(statuses) < 500
    assert {code for code in codes.values() if code and not code.startswith(REFUSED)} == set()
    assert codes["good.csv"] is None
    assert all(codes[name] for name in meant), codes
    assert {len(done["attempts"]) for done in ended.values()} == {1}
    told = [json.dumps(done) for done in ended.values()]
    assert logs
    assert not [text for text in [*told, *logs] if SECRET in text]
