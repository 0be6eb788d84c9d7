"""Reading a template's file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.errors import InputError
from tests.ball_head import ball_head


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"an OBJ, renamed"])
def test_another_file_is_named(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "mine.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"mine\.npz") as caught:
        Template.load(tmp_path / "mine.npz")
    assert caught.value.code == "template.unreadable"


def test_what_a_template_has_learned_goes_with_its_tets(tmp_path: Path) -> None:
    head = ball_head()
    assert head.mesh is not None
    learned = replace(head.mesh, trained=np.array([0.2, 0.5, 0.3], dtype=np.float32))
    replace(head, mesh=learned).save(tmp_path / "trained.npz")
    mesh = Template.load(tmp_path / "trained.npz").mesh
    assert mesh is not None
    np.testing.assert_array_equal(mesh.trained, learned.trained)
    # other tets take it from the nearest, whose muscles may be others: here it lacks the first one
    two = np.vstack([mesh.tets, mesh.tets])
    weights = sp.csr_array(np.array([[0.5, 0.25, 0.25], [0.75, 0.0, 0.25]]))
    fine = replace(mesh, tets=two, weights=weights, trained=None)
    np.testing.assert_allclose(fine.trained_like(mesh), [0.2, 0.5, 0.3, 0.4, 0.6], rtol=1e-6)
    assert fine.trained_like(fine) is None


def two_points() -> SkinPoints:
    return SkinPoints(
        np.array([[0, 1, 2], [3, 4, 5]]),
        np.array([[0.5, 0.25, 0.25], [0.0, 0.0, 1.0]]),
        ("4", "33"),
        np.array([0.7, 1.5]),
    )


def test_points_of_a_detector_go_with_the_template(tmp_path: Path) -> None:
    head = ball_head()
    marked = replace(head, points=two_points())
    assert marked.save(tmp_path / "marked.npz") != head.save(tmp_path / "bare.npz")
    assert Template.load(tmp_path / "bare.npz").points is None
    points = Template.load(tmp_path / "marked.npz").points
    assert points is not None
    assert points.names == ("4", "33")
    np.testing.assert_array_equal(
        points.at(head.skin.vertices), two_points().at(head.skin.vertices)
    )
    assert points.select(["33"]).spread_mm.tolist() == [1.5]


@pytest.mark.parametrize(
    ("change", "code", "array"),
    [
        ({"names": ("4", "4")}, "shape", "names of points"),
        ({"names": ("4",)}, "shape", "weights of points"),
        ({"corners": np.array([[0, 1, 2], [3, 4, 10**6]])}, "range", "corners of points"),
        ({"corners": np.array([[0, 1, 2]])}, "shape", "corners of points"),
        ({"weights": np.array([[0.5, 0.5, 0.5], [0, 0, 1]])}, "range", "weights of points"),
        ({"weights": np.array([[1.5, -0.5, 0], [0, 0, 1]])}, "range", "weights of points"),
        ({"weights": np.full((2, 3), np.nan)}, "nan", "weights of points"),
        ({"spread_mm": np.array([0.0, 1.0])}, "range", "spread of points"),
    ],
)
def test_points_that_are_on_no_skin_are_refused(
    change: dict[str, object], code: str, array: str, tmp_path: Path
) -> None:
    points = replace(two_points(), **change)  # type: ignore[arg-type]
    replace(ball_head(), points=points).save(tmp_path / "bad.npz")
    with pytest.raises(InputError) as caught:
        Template.load(tmp_path / "bad.npz")
    assert caught.value.code == f"template.{code}"
    assert caught.value.context["array"] == array
