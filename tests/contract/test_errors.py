"""The handbook of errors knows every code that the source can say, and no other."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

from solver.kinds import ROLES, SCANS

ROOT = Path(__file__).parents[2]
HANDBOOK = (ROOT / "docs" / "reference" / "errors.md").read_text(encoding="utf-8")
CODE = re.compile(r"[a-z][a-z0-9_]*(?:\.[a-z0-9_]+)+|internal|timeout|worker_lost")
RAISED = {
    "Problem": 1,
    "faulty": 1,
    "InputError": 0,
    "SolveError": 0,
    "Refused": 0,
    "Unreachable": 0,
}
"""Which argument of an error is its code."""
WITH_STATUS = ("Problem", "faulty")
HELPERS = {"unauthorized_problem": 0, "_check_format": 1}
MADE_OF_PARTS = (
    *(
        "http.",
        "live_link.",
        "openface.",
        "video.",
        "film.",
        "options.",
        "template.",
        "model.",
        "basis.",
    ),
    *("capture.format", "blendshapes.format", "fibres.format", "markers.format", "tracks.format"),
    *("controls.format", "control_pairs.format", "live_skin.format", "live_skin.unreadable"),
    *("live_samples.format", "live_takes.format"),
)
"""Codes that the source puts together, or passes on."""
STATUS = {"CHECKSUM_MISMATCH": "460"}


@cache
def _source() -> tuple[list[tuple[str, ast.Call]], set[str]]:
    """Return the calls that may say a code, and every text: a code may be passed on as one."""
    names = {*RAISED, *HELPERS, "not_found"}
    calls = []
    texts = set()
    for room in ("service", "worker", "solver", "myoface"):
        for path in (ROOT / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    texts.add(node.value)
                elif (
                    room != "myoface"
                    and isinstance(node, ast.Call)
                    and isinstance(node.func, ast.Name)
                    and node.func.id in names
                ):
                    calls.append((node.func.id, node))
    return calls, texts


def _said() -> dict[str, set[str]]:
    """Return the codes that errors are raised with, each with its statuses."""
    found: dict[str, set[str]] = defaultdict(set)
    for name, call in _source()[0]:
        place = RAISED.get(name, HELPERS.get(name))
        if name == "not_found" and isinstance(call.args[0], ast.Constant):
            found[f"{call.args[0].value}.unknown"].add("404")
        elif place is not None and len(call.args) > place:
            code = call.args[place]
            if isinstance(code, ast.Constant) and CODE.fullmatch(str(code.value)):
                found[str(code.value)].update(_status(call) if name in WITH_STATUS else ())
    return found


def _status(call: ast.Call) -> set[str]:
    text = ast.unparse(call.args[0])
    return set(STATUS.get(text, text).split(", "))


def _explained() -> dict[str, list[str]]:
    """Return the handbook's codes with the cells of their rows."""
    rows = {}
    for line in HANDBOOK.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        for code in re.findall(r"`([^`]+)`", cells[0]) if line.startswith("| `") else ():
            assert code not in rows, f"{code} is explained twice"
            rows[code] = cells
    return rows


def test_every_code_is_explained() -> None:
    missing = sorted(set(_said()) - set(_explained()))
    assert not missing, f"docs/reference/errors.md does not say what to do about {missing}"


def test_the_handbook_explains_no_code_that_nobody_says() -> None:
    of_roles = {f"capture.is_{name}" for name in ROLES if name not in SCANS}
    texts = _source()[1] | set(_said()) | of_roles
    stale = [
        code
        for code in _explained()
        if code not in texts and not code.startswith(MADE_OF_PARTS) and not code.endswith("*")
    ]
    assert not stale


def test_every_row_says_what_to_do_and_the_right_status() -> None:
    said = _said()
    for code, cells in _explained().items():
        assert all(cells), code
        if said.get(code):
            assert set(cells[1].split(", ")) == said[code], (code, cells[1], said[code])
