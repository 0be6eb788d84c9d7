"""The kinds of job say the same to the API and to the solver."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.main import get_command

from myoface.cli.offline import solve
from service.captures import service as captures
from service.kinds import KINDS
from service.queue.wakeups import QUEUES
from solver import pipeline
from solver.errors import InputError
from solver.mechanics.linear import DOUBLE, SOLVERS
from solver.meshio import raw, registered
from solver.rig import (
    frames,
)
from solver.scans import performance
from solver.scene import document
from worker import attempt

ROOT = Path(__file__).parents[2]
FILES = {"fit_activations": 2, "fit_sequence": 3, "build_preview": 3}
"""How many files a kind of job reads, besides captures."""


@pytest.mark.parametrize("kind", KINDS)
def test_options_are_those_of_the_pipeline(kind: str, tmp_path: Path) -> None:
    files = FILES.get(kind, 1) * [tmp_path / "x"]
    scans = [{"smile": tmp_path / "smile.obj"}] if "captures" in KINDS[kind].reads else []
    with pytest.raises(InputError) as caught:
        getattr(pipeline, kind)(*files, *scans, tmp_path, options={"no such option": 1})
    assert caught.value.code == "options.unknown"
    known_to_the_worker = ["role"] if kind == "check_scan" else []
    options = [*KINDS[kind].options["properties"], *known_to_the_worker]
    assert caught.value.context["expected"] == sorted(options)
    assert KINDS[kind].queue in QUEUES


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_line_has_the_options_and_their_defaults(kind: str) -> None:
    command = get_command(solve).commands[kind.removeprefix("fit_").replace("_", "-")]
    given = {param.name: param for param in command.params}
    for option, schema in KINDS[kind].options["properties"].items():
        assert given[option].default in (schema.get("default"), None)


@pytest.mark.parametrize("folder", ["tests/standin", "tests/browser/standin"])
def test_stand_ins_are_called_as_the_pipeline_is(folder: str) -> None:
    made = importlib.util.spec_from_file_location("standin", ROOT / folder / "solver/pipeline.py")
    assert made is not None
    assert made.loader is not None
    standin = importlib.util.module_from_spec(made)
    made.loader.exec_module(standin)
    for kind in KINDS.keys() & vars(standin).keys():
        real, played = (_arguments(getattr(each, kind)) for each in (pipeline, standin))
        assert played[0] == real[0], kind
        assert played[1] <= real[1], kind
    files = {each.name for each in dataclasses.fields(pipeline.PersonFiles)}
    assert set(standin.PersonFiles._fields) == files


def _arguments(call: Callable[..., object]) -> tuple[list[str], set[str]]:
    """Return the names of what is given by its place, and by its name only."""
    known = inspect.signature(call).parameters.values()
    named = {each.name for each in known if each.kind is each.KEYWORD_ONLY}
    return [each.name for each in known if each.name not in named], named


def test_scenes_are_those_of_the_solver() -> None:
    for kind in ("simulate", "animate", "edit"):
        assert KINDS[kind].options["$defs"] == document.DEFINITIONS
        assert f"{kind}_scene" in document.DEFINITIONS


def test_a_fault_in_a_scene_is_named_where_it_is() -> None:
    scene = {"keys": [{"time": 0}], "forces": [{"kind": "wind", "m_s": [1, 2]}]}
    [fault] = KINDS["simulate"].faults({"scene": scene})
    assert fault == {"where": "options.scene.forces[0].m_s", "message": "[1, 2] is too short"}


def test_scans_may_be_what_the_solver_reads() -> None:
    assert captures.FORMATS == registered.REGISTERED_FORMATS
    assert tuple(raw.FORMATS) == captures.RAW_FORMATS
    assert captures.PERFORMANCE_FORMATS == performance.FORMATS
    assert set(registered.REGISTERED_FORMATS) < set(captures.ASSET_FORMATS)


def test_frames_are_where_the_worker_looks() -> None:
    assert attempt.FRAMES == frames.FRAMES


def test_linear_solvers_are_those_of_the_solver() -> None:
    for kind, names in (
        ("fit_geometry", DOUBLE),
        ("fit_activations", SOLVERS),
        ("fit_sequence", SOLVERS),
        ("simulate", SOLVERS),
        ("animate", SOLVERS),
    ):
        offered = KINDS[kind].options["properties"]["linear_solver"]["enum"]
        assert offered == [*names, None]
