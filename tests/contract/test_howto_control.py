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
