"""Tets of a template without any are made once and kept."""

from dataclasses import replace

from solver.anatomy import meshing
from solver.anatomy.meshing import find_or_make_mesh
from tests.solver.ball import EDGE_MM, ball_template, meshed_ball


def test_tets_are_made_once_and_anew_if_the_file_was_spoilt(tmp_path, monkeypatch):
    made = []
    ball = meshed_ball()

    def make_mesh(template, edge_mm, _progress, _options):
        assert template.sha256 == ball_template().sha256
        made.append(edge_mm)
        return ball.mesh

    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path))
    monkeypatch.setattr(meshing, "make_mesh", make_mesh)
    first = find_or_make_mesh(ball_template(), EDGE_MM)
    assert first.sha256 == ball.sha256
    assert find_or_make_mesh(ball_template(), EDGE_MM).sha256 == first.sha256
    assert find_or_make_mesh(first, EDGE_MM) is first
    assert made == [EDGE_MM]
    (kept,) = tmp_path.iterdir()
    kept.write_bytes(kept.read_bytes()[:1000])
    assert find_or_make_mesh(ball_template(), EDGE_MM).sha256 == first.sha256
    assert made == [EDGE_MM, EDGE_MM]
    replace(ball, name="another").save(kept)  # what a job may leave that was taken over
    assert find_or_make_mesh(ball_template(), EDGE_MM).sha256 == first.sha256
    assert made == 3 * [EDGE_MM]
    assert list(tmp_path.iterdir()) == [kept]
