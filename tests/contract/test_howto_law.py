"""The how-to for a new law, followed to the letter in a copy of the tree."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contract.howto import Followed, copy_tree, follow, page

PAGE = page("add-a-law")
MOST_FILES = 4

FIT = """
import numpy as np

from solver.fitting import activation
from solver.fitting.face import Face
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.mechanics import laws
from solver.mechanics.flesh import Material
from tests.solver.block import block_model, poses

model = block_model()
{use}
pose, rest = poses(1)[0], face.rest
stretch = np.diag([1.1, 0.9, 1.05])
identity, moduli = tuple(face.flesh.passive()[0]), (1.0, 1.0, 3.0, 5.0)
number = laws.number("st_venant_kirchhoff")
psi = laws.density(number, tuple(stretch.ravel()), identity, moduli)
# not the kernels of the tree before
whole = face.flesh.energy(model.rest @ stretch, face.flesh.passive())
np.testing.assert_allclose(whole, psi * face.flesh.volumes.sum())
points = face.face_points(face.continuation(rest, pose).x)
target = Target.from_points(points)
prior = Regulariser(w_a=1e-9, w_v=0.0, w_b=1e-12, prior=face.rest_pose())
options = activation.ActivationOptions(max_iterations=100, tolerance=1e-10)
fitted = activation.fit(face, SkinDistance(face, target), prior, rest, options)
left = target.distances(face.face_points(fitted.state.x)).max()
moved = target.distances(face.face_points(model.rest)).max()
assert face.flesh.material.law == "st_venant_kirchhoff"
assert moved > 1.0 and left < 1e-3 * moved, (moved, left)
assert np.abs(fitted.state.pose.a - pose.a).max() < 0.02
"""


TWO_LAWS = """
from typing import get_args

from solver.mechanics import laws

assert set(get_args(laws.Law)) >= {"corotated", "neo_hookean", "hencky", "st_venant_kirchhoff"}
stretch, identity = (1.1, 0.0, 0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 1.05), (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
moduli = (1.0, 1.0, 3.0, 5.0)
corotated, first, second = (
    laws.density(laws.number(law), stretch, identity, moduli)
    for law in ("corotated", "hencky", "st_venant_kirchhoff")
)
assert first == second != corotated
"""


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Followed:
    """Return a copy of the solver and its tests with the law in it."""
    tree = tmp_path_factory.mktemp("tree")
    copy_tree(tree, "solver", "tests/solver", "tests/fixtures.py")
    return follow(PAGE, tree)


def test_few_files_are_touched(followed: Followed) -> None:
    assert len(followed.created) == 1
    assert 1 < len({*followed.created, *followed.changed}) <= MOST_FILES
    assert followed.code


def test_the_files_of_the_how_to_are_in_style(followed: Followed) -> None:
    followed.check_style()


def test_the_law_agrees_with_finite_differences(followed: Followed) -> None:
    followed.test("-k", "st_venant", "tests/solver/mechanics/test_laws.py")


def test_an_expression_is_fitted_with_it(followed: Followed) -> None:
    followed.run("-c", FIT.format(use="".join(followed.code)))


def test_the_page_fits_a_tree_with_another_law(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that a law can be added without a change of the page."""
    copy_tree(tmp_path, "solver")
    another = PAGE.replace("st_venant_kirchhoff", "hencky")
    before = follow(another.replace("ST_VENANT_KIRCHHOFF", "HENCKY"), tmp_path)
    before.run("-m", "ruff", "check", "-q", "--fix", *before.changed)
    follow(PAGE, tmp_path)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    before.run("-c", TWO_LAWS)
