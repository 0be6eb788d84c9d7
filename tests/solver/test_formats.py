"""The numbers that files of ours say of their format, read without numerics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from solver.kinds import FILES, format_number
from solver.storage import Archive
from tests.fixtures import small_model, small_rig


def test_archives_arrays_and_documents_say_their_number(tmp_path: Path) -> None:
    small_model().save(tmp_path / "model.npz")
    small_rig().save(tmp_path / "rig.npz")
    np.savez_compressed(tmp_path / "sequence.npz", format=2, fps=30.0)
    (tmp_path / "markers.json").write_text('{"format": 1, "markers": []}')
    Archive({"format": 3}, {"x": np.zeros(3)}).write(tmp_path / "basis.npz")
    found = {path.name: format_number(path) for path in tmp_path.iterdir()}
    assert found == {
        "model.npz": FILES["model.npz"].format,
        "rig.npz": FILES["rig.npz"].format,
        "sequence.npz": 2,
        "markers.json": 1,
        "basis.npz": 3,
    }


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.npz", b""),
        ("a.npz", b"PK\3\4 cut off"),
        ("a.json", b"places"),
        ("a.json", b"[" * 100_000),
        ("a.json", b'{"format": "1"}'),
        ("a.json", b'{"format": true}'),
        ("a.json", b"\xff"),
    ],
)
def test_what_is_no_file_of_ours_has_none(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    assert format_number(tmp_path / name) is None
    assert format_number(tmp_path / "gone.npz") is None


def test_an_archive_of_others_has_none(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    assert format_number(tmp_path / "other.npz") is None
