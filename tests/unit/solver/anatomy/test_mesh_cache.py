"""Tets of a template without any are made once and kept."""

from solver.anatomy import mesh_cache
from solver.anatomy.mesh_cache import meshed
from tests.unit.solver.ball import ball_template

EDGE_MM = 18.0


def test_tets_are_made_once_and_anew_if_the_file_was_spoilt(tmp_path, monkeypatch):
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path))
    first = meshed(ball_template(), EDGE_MM)
    assert first.mesh is not None
    with monkeypatch.context() as without_mesher:
        without_mesher.delattr(mesh_cache, "with_mesh")
        assert meshed(ball_template(), EDGE_MM).sha256 == first.sha256
        assert meshed(first, EDGE_MM) is first
    (kept,) = tmp_path.iterdir()
    kept.write_bytes(kept.read_bytes()[:1000])
    assert meshed(ball_template(), EDGE_MM).mesh is not None
    assert list(tmp_path.iterdir()) == [kept]
