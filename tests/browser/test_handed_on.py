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


def _takes(studio: Studio, subject: str) -> list[str]:
    """Return the take and the marker set that was uploaded."""
    found = studio.get(f"/v1/subjects/{subject}/captures")["items"]
    return [each["id"] for each in found if each["role"] == "markers"]
