"""Names and roles of scans by their files: the command line's rule, and that of the page."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from myoface.errors import ApiError
from myoface.names import LEGAL, by_files, name_scans, name_session
from solver.kinds import LANDMARKS, ROLES
from tests.command_line import invoke

ROOT = Path(__file__).parents[2]
CASES = json.loads((ROOT / "tests/fixtures/scan_names.json").read_text(encoding="utf-8"))
PAGE = ROOT / "service/page/static/js/scan_files.js"

IN_NODE = """
import { named } from "./scan_files.mjs";
const [cases, roles] = process.argv.slice(1).map(JSON.parse);
const rows = cases.map((files) => named(files, roles).map(({ name, role }) => [name, role]));
console.log(JSON.stringify(rows));
"""


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["files"][0])
def test_names_and_roles_are_those_of_the_table(case: dict[str, Any]) -> None:
    found = by_files(case["files"])
    assert [list(each) for each in found] == case["named"]
    assert all(not name or LEGAL.fullmatch(name) for name, _ in found)


def test_the_page_has_the_same_rule(tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no node here")
    shutil.copy(PAGE, tmp_path / "scan_files.mjs")
    files = json.dumps([case["files"] for case in CASES])
    roles = json.dumps([{"role": name, **asdict(role)} for name, role in ROLES.items()])
    command = [node, "--input-type=module", "-e", IN_NODE, files, roles]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [case["named"] for case in CASES]


SORTED = """
import { sorted } from "./scan_files.mjs";
const [files, limits] = process.argv.slice(1).map(JSON.parse);
const { scans, others } = sorted(files, limits);
const told = scans.map((each) =>
  [each.file.name, each.name, each.role, each.landmarks?.name ?? null]);
console.log(JSON.stringify([told, others.map(({ name }) => name)]));
"""


@pytest.mark.parametrize(
    ("files", "scans", "others"),
    [
        (
            ["smile.jpg", "smile.json", "plain.PNG", "notes.txt"],
            [["plain.PNG", "plain", "photo", None], ["smile.jpg", "smile", "photo", "smile.json"]],
            ["notes.txt"],
        ),
        (  # a picture among scans is a texture
            ["smile.obj", "smile.jpg", "smile.json", "smile.mtl"],
            [["smile.obj", "smile", "expression", "smile.json"]],
            ["smile.jpg", "smile.mtl"],
        ),
    ],
)
def test_the_page_tells_photographs_from_textures(
    tmp_path: Path, files: list[str], scans: list[list[str | None]], others: list[str]
) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no node here")
    shutil.copy(PAGE, tmp_path / "scan_files.mjs")
    limits = {
        "raw_scan_formats": ROLES["expression"].registered,
        "landmark_formats": LANDMARKS,
        "roles": [{"role": name, **asdict(role)} for name, role in ROLES.items()],
    }
    named = json.dumps([{"name": name} for name in files])
    command = [node, "--input-type=module", "-e", SORTED, named, json.dumps(limits)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [scans, others]


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (["   .obj"], "no name can be made of '   .obj'"),
        (["Lächeln.obj", "lacheln.ply"], "would both be called lacheln"),
        (["smile 1.obj", "smile_1.obj"], "'smile 1.obj' and 'smile_1.obj' would both be called"),
        (["nul.obj"], "'nul.obj' is a device's name on Windows"),
        (["(aux).obj"], "is a device's name on Windows"),
        (["neutral.obj", "neutral 2.obj"], "both are neutrals by name"),
    ],
)
def test_what_has_no_name_of_its_own_is_refused(files: list[str], words: str) -> None:
    with pytest.raises(ApiError, match=words) as caught:
        name_scans([Path(file) for file in files])
    assert caught.value.code == "client.name"


def test_a_name_that_is_given_is_refused_with_its_own_fault() -> None:
    for name, words in (("com1", "is a device's name"), ("  ", "no name can be made of '  '")):
        told = invoke(["captures", "edit", "Ada", "smile", "--name", name])
        assert told.exit_code == 2
        assert words in told.output
        assert "digit is needed, and no device" not in told.output


def test_what_is_given_comes_before_the_file_s_name() -> None:
    paths = [Path("neutral.obj"), Path("neutral 2.obj")]
    named = name_scans(paths, names=[None, "Größer 2"], roles=[None, "expression"])
    assert [(each.name, each.role) for each in named] == [
        ("neutral", "neutral"),
        ("Grosser_2", "expression"),
    ]
    with pytest.raises(ApiError, match="no name can be made of '  '"):
        name_scans([Path("smile.obj")], names=["  "])


def test_a_neutral_that_is_given_may_be_among_the_others_too(tmp_path: Path) -> None:
    files = ["neutral.obj", "neutral 2.obj", "smile.obj", "take.npy"]
    paths = [tmp_path / file for file in files]
    roles = {"neutral", "neutral_2", "smile", "take"}
    for neutral in (paths[0], tmp_path / "x" / ".." / "neutral.obj"):
        (tmp_path / "x").mkdir(exist_ok=True)
        named = name_session(neutral, paths)
        assert {each.name for each in named} == roles
        assert [each.role for each in named] == [
            "neutral",
            "expression",
            "expression",
            "performance",
        ]
    assert [each.role for each in name_session(None, paths[2:])] == ["expression", "performance"]
