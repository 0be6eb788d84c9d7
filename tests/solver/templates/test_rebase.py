"""A template on other heads: their own vertices, a sound anatomy, and a sentence for bad ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.anatomy.meshing import find_or_make_mesh
from solver.anatomy.template import Template
from solver.anatomy.tetrahedra import volumes
from solver.errors import InputError
from solver.meshio.obj import write_obj
from solver.meshio.raw import mend, read_raw
from solver.registration.register import register
from solver.registration.topology import topology
from solver.surface import Surface, join_surfaces
from solver.templates.builtin.build import builtin_capture_set, builtin_template
from solver.templates.rebase import rebase
from solver.templates.report import report_template
from tests.ball_head import ball, ball_head
from tests.fixtures import data_folder


def written(folder: Path, surface: Surface) -> Path:
    write_obj(folder / "head.obj", surface)
    return folder / "head.obj"


@pytest.fixture(scope="module")
def template() -> Template:
    return find_or_make_mesh(builtin_template())


def codes(findings: list[dict[str, object]]) -> set[object]:
    return {finding["code"] for finding in findings}


def test_what_is_no_base_mesh_is_refused_before_any_work(tmp_path: Path) -> None:
    head = ball((0, 0, 0), 100.0, 3)
    cloud = tmp_path / "head.xyz"
    np.savetxt(cloud, head.vertices)
    torn = Surface(head.vertices[head.faces.ravel()], np.arange(head.faces.size).reshape(-1, 3))
    large = tmp_path / "large.obj"
    large.write_text("v 0 0 0\n" * 100_001 + "f 1 2 3\n")
    for file, code, words in (
        (cloud, "rebase.faces", "cloud of points"),
        (written(tmp_path, torn), "rebase.doubled", "do not share vertices"),
        (large, "scan.too_large", "100001 vertices"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            rebase(ball_head(), file)
        assert caught.value.code == code


@pytest.mark.slow
def test_a_person_in_cm_with_z_up_and_other_numbers_becomes_the_skin(
    template: Template, tmp_path: Path
) -> None:
    person = builtin_capture_set().neutral
    order = np.random.default_rng(2).permutation(len(person.vertices))
    x, y, z = person.vertices[order].T + np.array([[0.0], [1500.0], [20.0]])
    place = np.argsort(order)
    file = written(tmp_path, Surface(np.column_stack([x, -z, y]) / 10, place[person.faces]))
    made = rebase(template, file, name="studio")
    based = made.template
    assert based.name == "studio"
    assert np.allclose(based.skin.vertices, np.column_stack([x, y, z]), atol=1e-4)
    report = report_template(based)
    assert report.good, report.findings
    assert report.figures["mesh"]["inverted"] == 0
    # every vertex of the face knows which it was, within an edge or so
    was = order[list(based.landmarks.values())]
    off = person.vertices[was] - person.vertices[[template.landmarks[n] for n in based.landmarks]]
    assert np.median(np.linalg.norm(off, axis=1)) < 2.0
    assert based.landmarks.keys() == template.landmarks.keys()
    assert based.points is not None
    assert template.points is not None
    kept = template.points.select(list(based.points.names))
    assert len(kept.names) > 0.95 * len(template.points.names)
    wanted = replace(kept, corners=place[kept.corners]).at(based.skin.vertices)
    away = np.linalg.norm(based.points.at(based.skin.vertices) - wanted, axis=1)
    assert np.median(away) < 1.0
    for name in ("upper_lip", "lower_lip", "upper_teeth", "left_eyeball"):
        both = np.intersect1d(order[based.regions[name]], template.regions[name])
        assert len(both) > 0.8 * len(template.regions[name]), name
    jaw = template.shapes.expression_names.index("jawOpen")
    moved = template.shapes.expressions[jaw][order], based.shapes.expressions[jaw]
    face = based.face_vertices
    assert np.linalg.norm(moved[0] - moved[1], axis=1)[face].mean() < 0.3


@pytest.mark.slow
def test_a_face_without_mouth_eyes_and_back_is_sound_and_registers(template: Template) -> None:
    folder = data_folder("scans", "meshmonk")
    made = rebase(template, folder / "Template.obj")
    assert {"rebase.parts"} <= codes(made.registration["findings"])
    based = made.template
    report = report_template(based)
    assert report.good, report.findings
    assert volumes(based.mesh.vertices, based.mesh.tets).min() > 0
    known = topology(based)
    found = register(mend(read_raw(folder / "DemoFace_10K.obj"))[0], known)
    seen = known.face[found.trust.covered[known.face]]
    assert found.trust.distance_mm[seen].mean() < 0.5


@pytest.mark.slow
def test_two_heads_and_a_wrong_unit_are_named(template: Template, tmp_path: Path) -> None:
    person = builtin_capture_set().neutral
    twice = join_surfaces(
        [person, person.with_vertices(person.vertices + np.array([260.0, 0.0, 0.0]))]
    )
    with pytest.raises(InputError, match="two heads"):
        rebase(template, written(tmp_path, twice))
    with pytest.raises(InputError, match="it fits in mm") as caught:
        rebase(
            template,
            written(tmp_path, person),
            frame={"unit": "cm", "up": "auto", "forward": "auto"},
        )
    assert caught.value.code == "scan.scale"
