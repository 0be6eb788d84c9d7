"""Necks of OpenSim from strangers, through the API and the real solver."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest

from myoface.stack import Stack
from service.settings import Settings
from solver.neck.builtin import builtin_neck
from tests.kills.test_killed_simulation import fitted
from tests.osim_file import mutated, osim_text
from tests.service_client import QUICK, ROOT, Studio, eventually
from tests.solver.block import head_block

FILES = 100
SOLVER_MB = 2048
API_MB = 100  # that the API may take for them
SECRET = "98765.4321"
NECK = osim_text(builtin_neck())
REFUSED = {"neck.osim", "neck.goal", "neck.unstable", "neck.voluntary"}


def declared(inside: str, mass: str) -> str:
    """Return a neck whose torso's mass is an entity that a document type declares."""
    text = NECK.replace("<OpenSimDocument", f"<!DOCTYPE o [{inside}]><OpenSimDocument", 1)
    return text.replace("<mass>30.0", f"<mass>{mass}", 1)


def hostile(folder: Path) -> dict[str, str]:
    """Return files by name that somebody meant, and the error of each is ``neck.osim``."""
    secret = folder / "secret"
    secret.write_text(SECRET)
    ours = (folder / "data" / "admin.key").as_uri()
    bomb = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12))
    return {
        "file": declared(f'<!ENTITY x SYSTEM "{secret.as_uri()}">', "&x;"),
        "key": declared(f'<!ENTITY x SYSTEM "{ours}">', "&x;"),
        "parameter": declared(f'<!ENTITY % x SYSTEM "{secret.as_uri()}">%x;', "30.0"),
        "bomb": declared(f'<!ENTITY a0 "ha">{bomb}', "&a11;"),
        "deep": "<a>" * 200_000,
        "large": NECK + f"<!--{' ' * 100_000_000}-->",
        "included": NECK.replace(
            "<OpenSimDocument", '<OpenSimDocument xmlns:xi="http://www.w3.org/2001/XInclude"'
        ).replace("<mass>30.0", f'<mass><xi:include href="{secret.as_uri()}" parse="text"/>', 1),
    }


@pytest.mark.slow
def test_necks_that_nobody_would_write_are_refused_and_cost_the_service_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    settings = Settings(data_dir=tmp_path / "data", solver_memory_mb=SOLVER_MB, **QUICK)
    subject, rig = fitted(settings, tmp_path, head_block((7, 5, 1)))
    meant = hostile(tmp_path)
    files = meant | {f"spoilt{k}": mutated(NECK, k) for k in range(FILES - len(meant))}
    statuses = set[int]()
    with Stack(settings) as stack, httpx.Client(base_url=stack.url, timeout=60) as http:
        http.event_hooks["response"].append(lambda answer: statuses.add(answer.status_code))
        studio = Studio(http, stack.key)
        before = memory_mb(stack.pid("api"))
        jobs = {}
        for name, text in files.items():
            upload = studio.upload(f"{name}.osim", text.encode())
            path = f"/v1/subjects/{subject}/captures"
            asset = studio.post(path, name=name, role="asset", upload_id=upload)["id"]
            scene = {"fps": 5, "duration": 0.2, "neck": {"asset": name, "skin": False}}
            how = {"rig_id": rig, "captures": [asset], "options": {"scene": scene}}
            jobs[name] = studio.submit("simulate", subject, **how)
        ended = {name: studio.finished(job, seconds=600) for name, job in jobs.items()}
        assert memory_mb(stack.pid("api")) < before + API_MB
        eventually(lambda: not studio.solvers(stack))
        logs = [path.read_text() for path in settings.data_dir.rglob("*.log")]
    codes = {name: (done["error"] or {}).get("code") for name, done in ended.items()}
    assert max(statuses) < 500
    assert set(codes.values()) - {None} <= REFUSED, codes
    assert {codes[name] for name in meant} == {"neck.osim"}, codes
    assert None in codes.values()  # some are necks all the same
    assert {len(done["attempts"]) for done in ended.values()} == {1}
    told = [json.dumps(done) for done in ended.values()]
    assert logs
    assert not [text for text in [*told, *logs] if SECRET in text]


def memory_mb(pid: int) -> float:
    """Return the most memory that a process has had, in MB."""
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    return int(status["VmHWM"].split()[0]) / 1024
