"""The page of the API: Swagger UI as it was vendored, under the page's own policy."""

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.service_client import Studio

VENDOR = Path(__file__).parents[2] / "service" / "page" / "static" / "vendor" / "swagger-ui"
MOST_BYTES = 1_700_000


def test_the_bundle_is_the_one_that_was_made_with_its_licences() -> None:
    made = json.loads((VENDOR / "VERSION.json").read_text())
    content = (VENDOR / "swagger-ui.js").read_bytes()
    assert made["name"] == "swagger-ui"
    assert re.fullmatch(r"\d+\.\d+\.\d+", made["version"])
    assert hashlib.sha256(content).hexdigest() == made["sha256"]
    assert len(content) < MOST_BYTES
    assert "Apache License" in (VENDOR / "LICENSE").read_text()
    assert "SmartBear" in (VENDOR / "NOTICE").read_text()
    assert "React" in (VENDOR / "LICENSES-OF-PARTS.txt").read_text()
    assert "@import" not in (VENDOR / "swagger-ui.css").read_text()


@pytest.mark.slow
def test_operations_are_shown_and_tried_under_the_policy(
    show: Callable[..., Any], studio: Studio
) -> None:
    studio.post("/v1/subjects", name="Ada of the API")
    asked: list[str] = []
    page = show("/queue")
    page.on("request", lambda request: asked.append(request.url))
    page.get_by_role("link", name="API", exact=True).click()
    page.locator(".opblock").first.wait_for()
    assert page.locator(".opblock").count() > 60
    listing = page.locator(".opblock").filter(has_text="List subjects").first
    listing.locator(".opblock-summary").click()
    page.get_by_role("button", name="Try it out").click()
    page.get_by_role("button", name="Execute").click()
    page.get_by_text("Ada of the API").first.wait_for()
    origin = str(studio.http.base_url).rstrip("/")
    assert all(url.startswith((origin, "data:", "blob:")) for url in asked), asked
