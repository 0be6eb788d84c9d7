"""The contracts of kinds of job: what the declarations cannot say themselves."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import jsonschema
import pytest
from PIL import Image

from myoface.cli.app import UNITS, EyeDistance
from myoface.cli.commands import Command, Option
from myoface.cli.offline import solve
from service.queue.wakeups import QUEUES
from solver.kinds import KINDS, ROLES, SCANS, OptionsError
from solver.kinds.inputs import ARCHIVES
from solver.kinds.kind import FrameOptions, UnitName
from solver.kinds.marker_set import MarkerSetDocument
from solver.kinds.photo import PhotoDocument
from solver.mechanics.linear import DOUBLE, SOLVERS
from solver.meshio import raw, registered
from solver.photo.picture import FORMATS
from solver.registration import units
from solver.rig import frames
from solver.scans import performance
from worker import attempt

ROOT = Path(__file__).parents[2]
STANDINS = ROOT / "tests" / "standin" / "jobs"
HEAVY = ("numpy", "scipy", "numba", "jsonschema", "sqlalchemy")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_a_job_and_a_queue(kind: str) -> None:
    assert callable(import_module(f"solver.jobs.{kind}").run)
    assert KINDS[kind].queue in QUEUES


def test_stand_ins_are_for_kinds_that_there_are() -> None:
    assert {path.stem for path in STANDINS.glob("[a-z]*.py")} <= set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_option_is_explained_and_has_a_default_but_a_document(kind: str) -> None:
    schema = KINDS[kind].schema
    jsonschema.Draft202012Validator.check_schema(schema)
    for rules in schema["properties"].values():
        assert rules["description"]
        assert "default" in rules or "$ref" in rules


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_line_has_the_options_and_their_defaults(kind: str) -> None:
    command = solve.members[kind.removeprefix("fit_").replace("_", "-")]
    assert isinstance(command, Command)
    parser = command.parser("solve")
    for option, schema in KINDS[kind].schema["properties"].items():
        assert parser.get_default(option) in (schema.get("default"), None)


def test_contracts_load_no_numerics() -> None:
    words = f"import sys, solver.kinds; print([m for m in {HEAVY!r} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("kind", "options", "where", "message"),
    [
        (
            "simulate",
            {"scene": {"keys": [{"time": 0}], "forces": [{"kind": "wind", "m_s": [1, 2]}]}},
            "options.scene.forces[0].m_s",
            "[1, 2] is too short",
        ),
        ("build_model", {"edge_mm": 1}, "options.edge_mm", "1 is less than the minimum of 3"),
        (
            "build_model",
            {"edge": 9},
            "options.edge",
            "build_model has no such option; it has edge_mm, muscles",
        ),
        (
            "fit_geometry",
            {"linear_solver": "rslab-single"},
            "options.linear_solver",
            "'rslab-single' is not one of 'rslab', 'cholmod', 'superlu' or None",
        ),
        (
            "fit_geometry",
            {"controls": "free", "plausibility": 0.5},
            "options.plausibility",
            "0.5 loosens bounds, which free controls do not have: use admissible ones",
        ),
        (
            "check_scan",
            {"unit": "mile"},
            "options.unit",
            "'mile' is not auto, mm, cm, m, inch, foot or a number of mm",
        ),
        ("check_scan", {"unit": -3}, "options.unit", "-3 is less than the minimum of 1e-06"),
        ("register_scan", {"unit": float("nan")}, "options.unit", "nan is not a number"),
        (
            "check_scan",
            {"unit": True},
            "options.unit",
            "True is not auto, mm, cm, m, inch, foot or a number of mm",
        ),
        (
            "check_scan",
            {"eye_distance_mm": 0},
            "options.eye_distance_mm",
            "0 is less than the minimum of 35",
        ),
        (
            "register_scan",
            {"unit": "cm", "eye_distance_mm": 62},
            "options.eye_distance_mm",
            "62 is given beside a unit: give one of the two",
        ),
        ("fit_sequence", {"fps": 0}, "options.fps", "0 is less than the minimum of 0.01"),
        ("fit_sequence", {"start": 1.5}, "options.start", "1.5 is not of type 'integer'"),
        ("edit", {}, "options", "'scene' is a required property"),
        (
            "edit",
            {"scene": {"edits": [{"kind": "bone", "at": None}]}},
            "options.scene.edits[0]",
            "'bone' is a required property",
        ),
        (
            "edit",
            {"scene": {"edits": [{"kind": "wings"}]}},
            "options.scene.edits[0].kind",
            "'wings' is not one of ['fat', 'filler', 'bone', 'stiffness', 'density', 'paralysis']",
        ),
        (
            "simulate",
            {"scene": {"keys": [{"time": 0, "muscles": {"a b": 9}}]}},
            "options.scene.keys[0].muscles['a b']",
            "9 is greater than the maximum of 1.5",
        ),
    ],
)
def test_a_fault_names_the_place_the_value_and_its_bounds(
    kind: str, options: dict[str, object], where: str, message: str
) -> None:
    with pytest.raises(OptionsError) as caught:
        KINDS[kind].read(options)
    assert caught.value.faults[0].as_dict() == {"where": where, "message": message}


def test_whole_numbers_may_be_written_with_a_point() -> None:
    assert KINDS["fit_geometry"].read({"rounds": 5.0}).model_dump()["rounds"] == 5


@pytest.mark.parametrize("kind", ["check_markers", "fit_markers"])
def test_frames_of_markers_are_counted_from_anywhere(kind: str) -> None:
    """A file may begin below 0, and a check names the frame that a fit is told."""
    assert KINDS[kind].read({"neutral": -3.0}).model_dump()["neutral"] == -3


def test_scans_may_be_what_the_solver_reads() -> None:
    for name in SCANS:
        assert ROLES[name].registered == registered.REGISTERED_FORMATS
        assert {*raw.FORMATS, *ARCHIVES} == set(ROLES[name].formats)
    assert ROLES["performance"].formats == performance.FORMATS
    assert set(registered.REGISTERED_FORMATS) < set(ROLES["asset"].formats)


def test_photographs_may_be_what_the_solver_reads() -> None:
    endings = {ending for ending, name in Image.registered_extensions().items() if name in FORMATS}
    assert set(ROLES["photo"].formats) <= endings
    assert ROLES["photo"].landmarks == (".json",)


def test_the_client_s_roles_are_those_declared() -> None:
    command = [sys.executable, "scripts/client_roles.py", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_contract_names_what_is_declared() -> None:
    kind = KINDS["fit_markers"]
    with pytest.raises(ValueError, match="no input is called marker_film"):
        replace(kind, reads=("rig", "marker_film"))
    with pytest.raises(ValueError, match=r"no file film\.bin is handed on"):
        replace(kind, hands_on=("film.bin",))


def test_frames_are_where_the_worker_looks() -> None:
    assert attempt.FRAMES == frames.FRAMES


@pytest.mark.parametrize("kind", KINDS)
def test_linear_solvers_are_those_of_the_solver(kind: str) -> None:
    rules = KINDS[kind].schema["properties"].get("linear_solver")
    if rules is not None:
        names = DOUBLE if kind in ("fit_geometry", "fit_fibres") else SOLVERS
        assert rules["enum"] == [*names, None]


def test_the_units_of_a_scan_are_the_same_for_jobs_solver_and_command_line() -> None:
    assert UNITS == get_args(UnitName) == ("auto", *units.UNITS)
    (option,) = (each for each in get_args(EyeDistance) if isinstance(each, Option))
    rules = FrameOptions.model_json_schema()["properties"]["eye_distance_mm"]
    assert {(option.min, option.max)} == {
        (each["minimum"], each["maximum"]) for each in rules["anyOf"] if "minimum" in each
    }


def _bounds(rules: Any) -> Iterator[str]:
    if isinstance(rules, dict):
        yield from (name for name in rules if not isinstance(rules[name], dict | list))
        for part in rules.values():
            yield from _bounds(part)
    elif isinstance(rules, list):
        for part in rules:
            yield from _bounds(part)


def test_what_has_to_be_above_0_has_a_floor() -> None:
    """1e-320 is above 0, and its inverse is infinite."""
    schemas = {name: kind.schema for name, kind in KINDS.items()}
    schemas["marker set"] = MarkerSetDocument.model_json_schema()
    schemas["photograph"] = PhotoDocument.model_json_schema()
    assert [name for name in schemas if "exclusiveMinimum" in set(_bounds(schemas[name]))] == []
