"""The how-to for a new control of muscles, followed to the letter in a copy of the tree."""

from __future__ import annotations

import pytest

from tests.contract.howto import Followed, copy_tree, follow, page

PAGE = page("add-a-control")
MOST_FILES = 2

CHECK = """
from solver.fitting.face import Face
from tests.solver.fitting import test_drives
from tests.solver.simulation.test_fibres import fibred_block

face = Face(fibred_block(), tolerance=1e-10)
{use}
assert driven.layout.drive.name == "shortening"
test_drives.check_rates(driven)
test_drives.check_rest(driven)
test_drives.check_round_trip(driven)
"""

KEEP = """
from pathlib import Path

import numpy as np

from solver.fitting.expression_basis import LINEAR, ExpressionBasis
from solver.fitting.face import Face
from solver.rig.expression import ExpressionFit
from solver.rig.rig import Rig
from tests.solver.simulation.test_fibres import fibred_block

face = Face(fibred_block())
{use}
skin = face.model.skin.vertices
off = np.full(len(skin), np.nan)
pulls = np.array([0.1, 0.2])
fit = ExpressionFit("smile", "train", pulls, np.zeros(5), skin, skin, off, 0, 1, 0.0, 0.0)
Rig(face.model, face.S, (fit,), drive=driven.drive).save(Path("rig.npz"))
shapes = 0.1 * np.random.default_rng(0).normal(size=(1, *skin.shape))
ExpressionBasis.solve(driven, shapes, LINEAR).save(Path("basis.npz"), driven)
np.save("shapes.npy", shapes)
"""

# by a process that has not imported the drive
READ = """
from pathlib import Path

import numpy as np

from solver.fitting.expression_basis import ExpressionBasis
from solver.rig.rig import Rig

rig = Rig.load(Path("rig.npz"))
face = rig.face()
assert type(face.drive).__name__ == "Shortening"
np.testing.assert_array_equal(rig.expression("smile").activations, [0.1, 0.2])
basis = ExpressionBasis.load(Path("basis.npz"), face, np.load("shapes.npy"))
assert np.abs(basis.whole[:, face.layout.muscles]).max() > 1e-4
"""


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Followed:
    """Return a copy of the solver and its tests with the drive in it."""
    tree = tmp_path_factory.mktemp("tree")
    copy_tree(tree, "solver", "tests/solver", "tests/fixtures.py")
    return follow(PAGE, tree)


def test_few_files_are_touched(followed: Followed) -> None:
    assert len(followed.created) == 1
    assert len({*followed.created, *followed.changed}) <= MOST_FILES
    assert followed.code


def test_the_files_of_the_how_to_are_in_style(followed: Followed) -> None:
    followed.check_style()


def test_faces_are_driven_by_it(followed: Followed) -> None:
    followed.run("-c", CHECK.format(use="".join(followed.code)))


def test_rigs_and_bases_keep_it(followed: Followed) -> None:
    followed.run("-c", KEEP.format(use="".join(followed.code)))
    followed.run("-c", READ)
