"""A link with a stranger's key takes nobody over to the stranger's studio."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.access import bootstrap
from service.app import create_app
from service.settings import Settings
from tests.hostile.edge import serving


@pytest.fixture
def place(tmp_path: Path) -> Iterator[tuple[str, str, str]]:
    """Serve the page for two studios; gives its address and a key of each."""
    settings = Settings(data_dir=tmp_path)
    app = create_app(settings)
    with serving(app, 30) as port:
        key = tmp_path / "other.key"
        bootstrap.add_tenant(app.state.store, app.state.keyring, "Mallory", key)
        yield f"http://127.0.0.1:{port}", settings.admin_key.read_text(), key.read_text()


def test_another_studio_s_key_is_asked_about(place: tuple[str, str, str], context: Any) -> None:
    url, mine, theirs = place
    page = context.new_page()
    page.goto(f"{url}/subjects#key={mine}")
    page.get_by_role("link", name="Signed in: default").wait_for()
    page.goto(f"{url}/subjects#key={theirs}")
    dialog = page.get_by_role("dialog")
    dialog.get_by_text("Sign in to Mallory?").wait_for()
    assert "default" in dialog.inner_text()
    dialog.get_by_role("button", name="Back").click()
    assert page.evaluate("sessionStorage.getItem('myoface.key')") == mine
    assert theirs not in page.url
    page.goto(f"{url}/upload#key={theirs}")
    page.get_by_role("dialog").get_by_role("button", name="Sign in to Mallory").click()
    page.get_by_role("link", name="Signed in: Mallory").wait_for()
    page.goto(f"{url}/subjects#key=myo_nonsense")  # nobody's: the tab's own stays
    page.get_by_role("link", name="Signed in: Mallory").wait_for()
    assert page.get_by_role("dialog").count() == 0


def test_a_key_that_cannot_be_read_leaves_the_page_as_it_is(
    place: tuple[str, str, str], context: Any
) -> None:
    faults: list[str] = []
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(f"{place[0]}/subjects#key=%")
    page.get_by_label("API key").wait_for()
    assert faults == []
