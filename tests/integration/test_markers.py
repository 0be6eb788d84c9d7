"""A take of markers through the service as docs/guide/markers.md has it: check, places, fit."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from myoface.client import Client
from myoface.errors import ApiError
from myoface.resources import FromJob
from myoface.stack import Stack
from service.settings import Settings
from service.store.models import DEFAULT_TENANT
from tests.browser.rig_place import put_rig
from tests.fixtures import small_rig
from tests.servers.production import Production
from tests.service_client import served
from tests.solver.scans.markers.made_actor import to_actor
from tests.solver.scans.markers.made_take import AWAY, LABELS, made_positions
from tests.take_files import c3d_bytes

DOCUMENT = Path(__file__).parents[2] / "docs" / "guide" / "markers.md"
FRAMES = slice(100, 220, 12)  # from rest into the first expressions

pytestmark = [pytest.mark.slow, pytest.mark.long]


@pytest.fixture(scope="module")
def session(
    parts: Production | None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Any]]:
    """A running service with a person's rig."""
    folder = tmp_path_factory.mktemp("rig")
    settings = Settings(data_dir=tmp_path_factory.mktemp("stack"), port=0)
    small_rig().save(folder / "rig.npz")
    with served(settings) as studio:
        store = studio.http.app.state.store.of(DEFAULT_TENANT)  # type: ignore[attr-defined]
        subject, rig = put_rig(store, "Ada", [folder / "rig.npz"], {})
    with Stack(settings) as stack, Client(stack.url, stack.key) as client:
        names = {"subject": SimpleNamespace(id=subject), "rig": SimpleNamespace(id=rig)}
        yield {"client": client, "Path": Path, **names}


def test_a_take_is_checked_bound_and_fitted_as_documented(
    session: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    points = made_positions(FRAMES.stop)[FRAMES]
    Path("take.c3d").write_bytes(c3d_bytes(points, list(LABELS), rate=5.0))
    (code,) = re.findall(r"^```python\n(.*?)^```$", DOCUMENT.read_text(), re.M | re.S)
    # the small person's skin is no template's
    code = code.replace("places], rig_id", "places], options={'prior': 'scans'}, rig_id")
    names = dict(session)
    exec(code, names)
    report = json.loads(Path("fit/sequence.json").read_text())
    assert report["fitted"] == len(points)
    assert report["mean_mm"] < 3.0
    header = Path("fit/activations.csv").read_text().splitlines()[0].split(",")
    assert "jaw.1.sd" in header
    assert Path("fit/markers.bin").read_bytes()[:4] == b"MYOV"
    _is_played(names["client"], names["subject"].id, names["rig"].id, names["fit"].id)


def _is_played(client: Client, subject: str, rig: str, fit: str) -> None:
    """Play a fitted take in a scene, and write it for other programs: no file comes back."""
    played = FromJob.of(client.job(fit).result["sequence.npz"], name="take-7")
    scene = {"performance": {"asset": "take-7"}, "fps": 5}
    options = {"scene": scene}
    film = client.run("simulate", subject, captures=[played], rig_id=rig, options=options)
    assert film.result.summary["frames"] == len(range(FRAMES.start, FRAMES.stop, FRAMES.step))
    assert film.result["animation.glb"].size > 0
    export = client.run("export_rig", subject, rig_id=rig, options={"format": "glb"})
    assert export.result["rig.glb"].size > 0


def test_another_actor_s_take_is_checked_and_carried(
    session: dict[str, Any], tmp_path: Path
) -> None:
    client = session["client"]
    subject = session["subject"].id
    rig = session["rig"].id
    points = to_actor(made_positions(FRAMES.stop)[FRAMES] - AWAY)
    file = tmp_path / "another.c3d"
    file.write_bytes(c3d_bytes(points, list(LABELS), rate=5.0))
    take = client.add_capture(subject, file, role="markers")
    meant = {"actor": True, "neutral": 1}
    check = client.run("check_markers", subject, captures=[take.id], rig_id=rig, options=meant)
    assert check.result.summary["verdict"] == "usable"  # at five frames a second
    meant["prior"] = "scans"
    fit = client.run("fit_markers", subject, captures=[take.id], rig_id=rig, options=meant)
    carried = fit.result.summary["actor"]
    assert carried["scale"] == pytest.approx(1.1, abs=0.1)
    assert carried["left_mm"] < 0.5 * carried["missed_mm"]
    assert fit.result.summary["notices"] == []


@pytest.mark.parametrize(
    ("content", "verdict", "code"),
    [
        (b"hello" * 200, "bad", "markers.unreadable"),
        (b"PathFileType\t4\t(X/Y/Z)\ta.trc\n", "bad", "markers.truncated"),
    ],
)
def test_a_take_that_cannot_be_read_is_told_by_the_check_and_refused_by_the_fit(
    session: dict[str, Any], tmp_path: Path, content: bytes, verdict: str, code: str
) -> None:
    client = session["client"]
    subject = session["subject"].id
    file = tmp_path / f"{code.replace('.', '-')}.c3d"
    file.write_bytes(content)
    take = client.add_capture(subject, file, role="markers")
    check = client.run("check_markers", subject, captures=[take.id])
    assert check.result.summary["verdict"] == verdict
    assert [each["code"] for each in check.result.summary["findings"]] == [code]
    fit = client.submit("fit_markers", subject, captures=[take.id], rig_id=session["rig"].id)
    with pytest.raises(ApiError) as caught:
        client.wait(fit.id)
    assert caught.value.code == code
