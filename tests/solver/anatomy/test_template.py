"""Reading a template's file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

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
