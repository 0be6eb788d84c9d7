"""The how-to for a new exporter, followed to the letter in a copy of the tree.

Its two files are written out of its code blocks; then a rig is written by the command line, by a
job as the API offers and a worker does it, and by what each fit calls.
"""

from __future__ import annotations

import re

import numpy as np
import pytest

from solver.mechanics.flesh import IDENTITY
from solver.rig import ExpressionFit, Rig
from tests.contract.howto import Followed, copy_tree, follow, page
from tests.solver.block import block_model

PAGE = page("add-an-exporter")
COMMAND = "from myoface.cli import main; main()"
BY_A_JOB = """
import json
from pathlib import Path
from service.system.schemas import KindView
from solver.kinds import KINDS
from worker.solve import solve
offered = KindView.of(KINDS["export_rig"], 1).options["properties"]["format"]["enum"]
rig = {"role": "rig", "name": "rig.npz", "path": "rig.npz"}
job = {"kind": "export_rig", "inputs": [rig], "options": {"format": "pc2"}, "resume": False}
Path("attempt").mkdir()
Path("attempt", "job.json").write_text(json.dumps(job))
told = solve(Path("attempt"), lambda step: None)["summary"]
print("pc2" in offered, told["file"], told["bytes"])
"""
AFTER_A_FIT = """
from pathlib import Path
from solver.rig.exporters import export_all
from solver.rig import Rig
print(*(each.path.name for each in export_all(Rig.load(Path("rig.npz")), Path("made"))))
"""


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Followed:
    """Return a copy of the tree with the how-to's files and a rig."""
    tree = tmp_path_factory.mktemp("tree")
    copy_tree(tree, "solver", "service", "worker", "myoface", "tests/solver")
    _rig().save(tree / "rig.npz")
    return follow(PAGE, tree)


def test_the_files_of_the_how_to_are_in_style(followed: Followed) -> None:
    assert (len(followed.created), followed.changed) == (2, [])
    followed.check_style()


def test_its_test_passes(followed: Followed) -> None:
    followed.test("tests/solver/rig/exporters/test_pc2.py")


def test_the_command_line_a_job_and_each_fit_write_the_file(followed: Followed) -> None:
    [line] = re.findall("^    myoface (solve export-rig .*)$", PAGE, re.MULTILINE)
    arguments = [part.strip("'") for part in re.findall(r"'[^']*'|\S+", line)]
    followed.run("-c", COMMAND, *arguments)
    made = (followed.tree / "smile" / "rig.pc2").read_bytes()
    assert made.startswith(b"POINTCACHE2\0")
    offered, file, size = followed.run("-c", BY_A_JOB).splitlines()[-1].split()
    assert (offered, file, int(size)) == ("True", "rig.pc2", len(made))
    listed = followed.run("-c", AFTER_A_FIT).split()
    assert {"rig.pc2", "rig.glb", "rig.npz"} <= set(listed)
    assert len((followed.tree / "made" / "rig.pc2").read_bytes()) == len(made)


def _rig() -> Rig:
    model = block_model()
    skin = model.skin.vertices + 2.0
    count = len(model.skin.vertices)
    a = np.tile(IDENTITY, (model.muscle_count, 1))
    none = np.zeros(count)
    fit = ExpressionFit("smile", "train", a, np.zeros(5), skin, skin, none, 0, 1, 0.0, 0.0)
    stretch = {name: {"fibres": 1.0} for name in model.muscle_names}
    smile = {"mean_mm": 0.0, "p95_mm": 0.0, "max_mm": 0.0, "muscles": stretch}
    figures = {"expressions": {"smile": smile}}
    return Rig(model, model.weights, (fit,), figures=figures)
