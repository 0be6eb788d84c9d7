"""The kinds of job say the same to the API and to the solver."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.main import get_command

from myoface.cli.offline import solve
from service.captures import service as captures
from service.kinds import KINDS
from service.store.queue import QUEUES
from solver import pipeline
from solver.errors import InputError
from solver.mechanics.linear import DOUBLE, SOLVERS
from solver.rig import sequence
from solver.scans import performance, raw, read
from worker import attempt


@pytest.mark.parametrize("kind", KINDS)
def test_options_are_those_of_the_pipeline(kind: str, tmp_path: Path) -> None:
    files = {"fit_activations": 2, "fit_sequence": 3, "build_preview": 3}.get(kind, 1) * [
        tmp_path / "x"
    ]
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
        assert given[option].default in (schema["default"], None)


def test_scans_may_be_what_the_solver_reads() -> None:
    assert captures.FORMATS == read.FORMATS
    assert tuple(raw.FORMATS) == captures.RAW_FORMATS
    assert captures.PERFORMANCE_FORMATS == performance.FORMATS


def test_frames_are_where_the_worker_looks() -> None:
    assert attempt.FRAMES == sequence.FRAMES


def test_linear_solvers_are_those_of_the_solver() -> None:
    for kind, names in (
        ("fit_geometry", DOUBLE),
        ("fit_activations", SOLVERS),
        ("fit_sequence", SOLVERS),
    ):
        offered = KINDS[kind].options["properties"]["linear_solver"]["enum"]
        assert offered == [*names, None]
