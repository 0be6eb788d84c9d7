"""A take checked, fitted and played in a scene on the page: no file comes back in between."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.service_client import Studio

pytestmark = pytest.mark.slow

Show = Callable[..., Any]


def test_a_take_is_checked_fitted_and_played_without_a_download(show: Show, studio: Studio) -> None:
    subject, rig = studio.rigged()
    studio._add(subject, "take", "markers", {})
    places = studio.upload("places.json", b"{}")
    path = f"/v1/subjects/{subject}/captures"
    studio.post(path, name="places", role="markers", upload_id=places)
    check = studio.done("check_markers", subject, rig_id=rig, captures=_takes(studio, subject))
    page = show(f"/jobs/{check['id']}")

    page.get_by_role("button", name="Fit the take").click()
    dialog = page.get_by_role("dialog")
    proposal = dialog.get_by_label("markers.json of Check markers", exact=False)
    assert proposal.is_checked()
    dialog.get_by_role("button", name="Submit").click()
    page.get_by_role("link", name="Play it on the rig").wait_for()
    fit = studio.job(page.url.rsplit("/", 1)[1])
    assert fit["from_jobs"] == [{"job": check["id"], "artifact": "markers.json", "name": None}]
    assert len(fit["captures"]) == 1
    assert fit["result"]["summary"]["places"] == "places"

    page.get_by_role("button", name="Play it in a scene").click()
    chosen = dialog.get_by_role("checkbox", name="sequence.npz of", exact=False)
    assert chosen.is_checked()
    dialog.get_by_label("What a scene calls sequence.npz", exact=False).fill("talk")
    scene = dialog.get_by_label("Scene", exact=True)
    assert '"asset": "sequence"' in scene.input_value()
    scene.fill(scene.input_value().replace('"asset": "sequence"', '"asset": "talk"'))
    dialog.get_by_role("button", name="Submit").click()
    page.wait_for_url(lambda url: not url.endswith(fit["id"]))
    film = studio.finished(page.url.rsplit("/", 1)[1])
    assert film["state"] == "succeeded"
    assert film["from_jobs"] == [{"job": fit["id"], "artifact": "sequence.npz", "name": "talk"}]


def test_signals_of_a_video_are_played_again_with_another_gain(show: Show, studio: Studio) -> None:
    subject, rig = studio.rigged()
    upload = studio.upload("talk.mp4", b"film")
    path = f"/v1/subjects/{subject}/captures"
    clip = studio.post(path, name="talk", role="asset", upload_id=upload)["id"]
    scene = {"recording": {"asset": "talk", "face": 1, "gain": 1.2}}
    how = {"rig_id": rig, "captures": [clip], "options": {"scene": scene}}
    first = studio.done("animate", subject, **how)
    page = show(f"/jobs/{first['id']}")

    page.get_by_role("button", name="Play its signals again").click()
    dialog = page.get_by_role("dialog")
    assert dialog.get_by_role("checkbox", name="signals.csv of", exact=False).is_checked()
    given = dialog.get_by_label("Scene", exact=True)
    given.fill(given.input_value().replace("1.2", "1.5"))
    dialog.get_by_role("button", name="Submit").click()
    page.wait_for_url(lambda url: not url.endswith(first["id"]))
    again = studio.finished(page.url.rsplit("/", 1)[1])
    assert again["state"] == "succeeded"
    assert again["from_jobs"] == [{"job": first["id"], "artifact": "signals.csv", "name": None}]
    assert again["options"]["scene"]["recording"] == {"asset": "signals", "gain": 1.5}
    assert again["result"]["summary"]["recording"] != first["result"]["summary"]["recording"]


def _takes(studio: Studio, subject: str) -> list[str]:
    """Return the take and the marker set that was uploaded."""
    found = studio.get(f"/v1/subjects/{subject}/captures")["items"]
    return [each["id"] for each in found if each["role"] == "markers"]
