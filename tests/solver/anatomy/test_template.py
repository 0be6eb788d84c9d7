"""Reading a template's file."""

from __future__ import annotations

from pathlib import Path

import pytest

from solver.anatomy.template import Template
from solver.errors import InputError


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"an OBJ, renamed"])
def test_another_file_is_named(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "mine.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"mine\.npz") as caught:
        Template.load(tmp_path / "mine.npz")
    assert caught.value.code == "template.unreadable"
