"""The how-to for a new law, followed to the letter in a copy of the tree."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HOWTO = (ROOT / "docs" / "develop" / "add-a-law.md").read_text(encoding="utf-8")
STEP = re.compile(r"^(Create|Change) `([^`]+)`:$|^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
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
psi = laws.density(2, tuple(stretch.ravel()), identity, moduli)
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


def follow(tree: Path) -> tuple[set[str], list[str]]:
    """Do what the page says in a tree; return the files it touched, and the code of its last part.

    "Create" takes the next block for a file's text, "Change" all diffs. Of commands all are run
    but the tests.
    """
    touched, use = set(), []
    path, verb = Path(), ""
    for found in STEP.finditer(HOWTO):
        if found[1]:
            verb, path = found[1], tree / found[2]
            touched.add(found[2])
        elif verb == "Create" and found[3] == "python":
            path.write_text(found[4], encoding="utf-8")
            verb = ""
        elif verb == "Change" and found[3] == "diff":
            lines = found[4].splitlines()
            before = "\n".join(line[1:] for line in lines if line[0] in " -")
            after = "\n".join(line[1:] for line in lines if line[0] in " +")
            text = path.read_text(encoding="utf-8")
            assert text.count(f"{before}\n") == 1, f"{path} has not one {before!r}"
            path.write_text(text.replace(f"{before}\n", f"{after}\n"), encoding="utf-8")
        elif found[3] == "python":
            use.append(found[4])
        elif found[3] == "sh" and "pytest" not in found[4]:
            subprocess.run(["sh", "-ec", found[4]], cwd=tree, check=True)
    return touched, use


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, set[str], list[str]]:
    """Return a copy of the solver and its tests with the law in it."""
    tree = tmp_path_factory.mktemp("tree")
    # with the kernels compiled so far, as in a tree that was worked in
    shutil.copytree(ROOT / "solver", tree / "solver")
    (tree / "tests").mkdir()
    shutil.copytree(ROOT / "tests" / "solver", tree / "tests" / "solver")
    shutil.copy(ROOT / "tests" / "fixtures.py", tree / "tests")
    return tree, *follow(tree)


def run(tree: Path, *arguments: str) -> None:
    """Run Python in a tree."""
    environment = os.environ | {"PYTHONPATH": str(tree)}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=tree, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def test_few_files_are_touched(copy: tuple[Path, set[str], list[str]]) -> None:
    _, touched, use = copy
    assert 1 < len(touched) <= MOST_FILES
    assert use


def test_the_law_agrees_with_finite_differences(copy: tuple[Path, set[str], list[str]]) -> None:
    tree, _, _ = copy
    run(tree, "-m", "pytest", "-q", "-k", "st_venant", "tests/solver/mechanics/test_laws.py")


def test_an_expression_is_fitted_with_it(copy: tuple[Path, set[str], list[str]]) -> None:
    tree, _, use = copy
    run(tree, "-c", FIT.format(use="".join(use)))
