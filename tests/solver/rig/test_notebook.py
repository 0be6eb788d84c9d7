"""A rig in a notebook's cell is what the page's own file has, in a frame that reaches nothing."""

from __future__ import annotations

import re
from base64 import b64decode
from html import unescape
from pathlib import Path

from solver.rig import Rig
from solver.rig.exporters import view
from tests.solver.rig.exporters.test_exporters import rig

__all__ = ["rig"]


def test_it_holds_the_view_and_needs_nothing_else(rig: Rig, tmp_path: Path) -> None:
    shown = rig.show(height=300)
    markup = shown._repr_html_()
    assert re.match(
        r'<iframe sandbox="allow-scripts" style="[^"]*height: 300px[^"]*" srcdoc="', markup
    )
    [inner] = re.findall(r'srcdoc="([^"]*)"></iframe>$', markup)
    assert unescape(inner) == shown.page
    [packed] = re.findall(r'<script id="content" type="text/plain">([^<]*)</script>', shown.page)
    view.write(rig, tmp_path / "view.bin")
    assert b64decode(packed) == (tmp_path / "view.bin").read_bytes()
    assert not re.search(r"https?:|src=|@import|fetch\(", shown.page.replace(packed, ""))
