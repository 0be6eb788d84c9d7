"""What a template's report says of a sound head of balls, and of each fault in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from solver.anatomy.template import Depth, Template
from solver.surface import Surface
from solver.templates.report import report_template
from tests.ball_head import ball, ball_head

Change = Callable[[Template], Template]


@pytest.fixture(scope="module")
def sound() -> Template:
    return ball_head()


def test_sound_template_has_no_findings(sound: Template) -> None:
    report = report_template(sound)
    assert report.findings == ()
    assert report.good
    assert report.figures["mesh"]["inverted"] == 0
    assert report.figures["content_sha256"] == sound.sha256


def flipped(surface: Surface) -> Surface:
    return Surface(surface.vertices, surface.faces[:, ::-1])


def moved(surface: Surface, by: tuple[float, float, float]) -> Surface:
    return surface.with_vertices(surface.vertices + by)


def left(template: Template, **changes: object) -> Template:
    """Return the template with another left muscle."""
    first, *others = template.muscles
    return replace(template, muscles=(replace(first, **changes), *others))  # type: ignore[arg-type]


def with_mesh(template: Template, **changes: object) -> Template:
    assert template.mesh is not None
    return replace(template, mesh=replace(template.mesh, **changes))  # type: ignore[arg-type]


FAULTS: dict[str, tuple[str, Change]] = {
    "licence.missing": ("warning", lambda t: replace(t, licence="unknown")),
    "source.missing": ("warning", lambda t: replace(t, source=" ")),
    "skin.size": ("error", lambda t: replace(t, skin=t.skin.with_vertices(t.skin.vertices / 10))),
    "skin.inside_out": ("error", lambda t: replace(t, skin=flipped(t.skin))),
    "skin.edges": (
        "error",
        lambda t: replace(t, skin=Surface(t.skin.vertices, np.vstack([t.skin.faces] * 2))),
    ),
    "parts.face": ("error", lambda t: replace(t, flesh_faces=t.flesh_faces[:300])),
    "parts.attached": (
        "error",
        lambda t: replace(t, attached_cranium=np.array([7]), attached_mandible=np.array([7])),
    ),
    "planes": ("error", lambda t: replace(t, back_z=30.0)),
    "parting": ("warning", lambda t: replace(t, parting=np.zeros_like(t.parting))),
    "bone.open": (
        "error",
        lambda t: replace(t, cranium=Surface(t.cranium.vertices, t.cranium.faces[1:])),
    ),
    "bone.inside_out": ("error", lambda t: replace(t, mandible=flipped(t.mandible))),
    "bone.outside": ("error", lambda t: replace(t, mandible=moved(t.mandible, (0, 0, 60)))),
    "bone.overlap": ("error", lambda t: replace(t, mandible=moved(t.mandible, (0, 12, 0)))),
    "condyle.side": ("error", lambda t: replace(t, condyles=t.condyles[::-1])),
    "condyle.place": ("error", lambda t: replace(t, condyles=t.condyles + np.array([0, 30, 0]))),
    "muscles.missing": ("error", lambda t: replace(t, muscles=(), mesh=None)),
    "muscle.twice": ("error", lambda t: replace(t, muscles=t.muscles[:1] * 2)),
    "muscle.volume": ("error", lambda t: left(t, surface=ball((20, -10, 80), 0.5))),
    "muscle.open": (
        "warning",
        lambda t: left(
            t, surface=Surface(t.muscles[0].surface.vertices, t.muscles[0].surface.faces[30:])
        ),
    ),
    "muscle.fibre": ("error", lambda t: left(t, fibre=np.array([0.0, 0.0, -1.0]))),
    "muscle.outside": ("error", lambda t: left(t, surface=ball((20, -10, 105), 8.0))),
    "muscle.in_bone": ("error", lambda t: left(t, surface=ball((20, 20, 40), 8.0))),
    "muscle.behind": ("error", lambda t: left(t, surface=ball((20, -10, -80), 8.0))),
    "muscle.origin": ("warning", lambda t: left(t, origin=np.array([80.0, -10.0, 20.0]))),
    "muscle.insertion": ("warning", lambda t: left(t, insertion=np.array([60.0, -40.0, 20.0]))),
    "muscle.pair": ("warning", lambda t: left(t, surface=ball((30, -10, 75), 12.0))),
    "muscle.side": ("error", lambda t: left(t, surface=ball((-30, -10, 80), 8.0))),
    "landmarks.missing": ("error", lambda t: replace(t, landmarks={}, depths=())),
    "landmarks.scheme": (
        "warning",
        lambda t: replace(t, landmarks={k: v for k, v in t.landmarks.items() if k != "menton"}),
    ),
    "landmarks.side": (
        "error",
        lambda t: replace(t, landmarks={**t.landmarks, "side_l": t.landmarks["side_r"]}),
    ),
    "landmarks.pair": (
        "warning",
        lambda t: replace(t, landmarks={k: v for k, v in t.landmarks.items() if k != "side_r"}),
    ),
    "landmarks.place": (
        "warning",
        lambda t: replace(
            t,
            flesh_faces=t.flesh_faces[~np.isin(t.skin.faces, 0).any(axis=1)],
            landmarks={**t.landmarks, "behind": 0},
        ),
    ),
    "depths.missing": ("warning", lambda t: replace(t, depths=())),
    "depths.landmark": (
        "error",
        lambda t: replace(t, depths=(Depth("nose", "cranium", 5, 1, "x"),)),
    ),
    "depths.range": ("error", lambda t: replace(t, depths=(Depth("tip", "cranium", 360, 2, "x"),))),
    "depths.bone": ("warning", lambda t: replace(t, depths=(Depth("tip", "cranium", 12, 2, "x"),))),
    "mesh.missing": ("warning", lambda t: replace(t, mesh=None)),
    "mesh.inverted": ("error", lambda t: with_mesh(t, tets=np.array([[0, 2, 1, 3]]))),
    "mesh.flat": (
        "warning",
        lambda t: with_mesh(
            t, vertices=np.array([[0.0, 0, 0], [200, 0, 0], [0, 200, 0], [60, 60, 2]])
        ),
    ),
    "mesh.uncovered": ("error", lambda t: with_mesh(t, embedded=np.arange(3))),
    "mesh.candidates": (
        "error",
        lambda t: with_mesh(t, weights=sp.csr_array(np.array([[0.9, 0.1, 0.0]]))),
    ),
    "mesh.volume": (
        "warning",
        lambda t: with_mesh(t, weights=sp.csr_array(np.array([[0.9999, 1e-4, 1e-4]]))),
    ),
}


@pytest.mark.parametrize("code", FAULTS)
def test_fault_is_found(code: str, sound: Template) -> None:
    severity, change = FAULTS[code]
    report = report_template(change(sound))
    found = {finding.code: finding.severity for finding in report.findings}
    assert found.get(code) == severity
    assert report.good == ("error" not in found.values())


def test_ring_needs_no_attachments(sound: Template) -> None:
    far = np.array([0.0, 0.0, -400.0])
    assert report_template(left(sound, ring=True, origin=far, insertion=far)).findings == ()


def test_muscle_beside_the_edge_of_the_skin_is_not_outside(sound: Template) -> None:
    height = sound.skin.vertices[sound.skin.faces, 1].mean(axis=1)
    crownless = replace(sound, flesh_faces=np.flatnonzero(height < 60))
    report = report_template(left(crownless, surface=ball((20, 95, 20), 8.0)))
    assert "muscle.outside" not in {finding.code for finding in report.findings}
