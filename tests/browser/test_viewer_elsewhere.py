"""A viewer in a page of another site: it reads what a signed URL opens, if its site is named."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.browser.stage import on_stage

# A header of its own makes the browser ask first
READ = """async (url) => {
    const headers = {"If-None-Match": '"another"', Range: "bytes=0-0"};
    const answer = await fetch(url, {headers}).catch((error) => error);
    return answer instanceof Error ? null : {
        status: answer.status,
        length: (await answer.arrayBuffer()).byteLength,
        range: answer.headers.get("Content-Range"),
    };
}"""


class Page(BaseHTTPRequestHandler):
    """An empty page."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.send_header("Content-Type", "text/html")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def site() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Page) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize("is_named", [True, False])
def test_a_page_reads_a_signed_url(is_named: bool, site: str, tmp_path: Path, context: Any) -> None:
    origins = [site] if is_named else ["https://review.studio.example"]
    with on_stage(tmp_path, viewer_origins=origins) as (stack, studio):
        _, rig = studio.rigged()
        artifact = studio.get(f"/v1/rigs/{rig}")["artifacts"][0]["id"]
        url = stack.url + studio.post(f"/v1/artifacts/{artifact}/url")["url"]
        page = context.new_page()
        page.goto(site)
        got = page.evaluate(READ, url)
        listed = page.evaluate(READ, f"{stack.url}/v1/limits")
    if is_named:
        assert (got["status"], got["length"], got["range"].split("/")[0]) == (206, 1, "bytes 0-0")
    else:
        assert got is None
    assert listed is None
