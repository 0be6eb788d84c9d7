"""One stack and one browser for the tests of the page; a console error fails a test."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.browser.rig_place import Place, drawing_browser, served_rigs
from tests.browser.stage import browser, on_stage
from tests.service_client import Studio


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory, chromium: Any) -> Iterator[Studio]:
    with on_stage(tmp_path_factory.mktemp("studio")) as (_stack, studio):
        yield studio


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as chromium:
        yield chromium


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    with served_rigs(tmp_path_factory.mktemp("rigs")) as place:
        yield place


@pytest.fixture(scope="module")
def drawing() -> Iterator[Any]:
    """A browser that draws the rig view."""
    with drawing_browser() as browser:
        yield browser


@pytest.fixture
def context(chromium: Any) -> Iterator[Any]:
    context = chromium.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(45_000)
    yield context
    context.close()


@pytest.fixture
def show(studio: Studio, context: Any) -> Iterator[Callable[..., Any]]:
    """Open a path of the page, signed in; the test fails if the page logs an error.

    The browser itself logs every request that fails; with ``refusals`` those are expected.
    """
    faults: list[str] = []

    def open_page(path: str = "/", *, key: str | None = studio.key, refusals: bool = False) -> Any:
        def hear(message: Any) -> None:
            is_refusal = message.text.startswith("Failed to load resource")
            if message.type == "error" and not (refusals and is_refusal):
                faults.append(message.text)

        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", hear)
        page.goto(f"{studio.http.base_url}".rstrip("/") + path + (f"#key={key}" if key else ""))
        return page

    yield open_page
    assert faults == []
