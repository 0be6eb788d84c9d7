"""Every input and option of every `solve` command, from the words typed to the job's call."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from myoface.cli import offline
from solver import jobs
from solver.jobs import Task
from solver.kinds import KINDS, Kind
from tests.command_line import invoke

# What is typed for each input of a contract, a file's name standing for its path; the rest is an
# option. Then the roles of the files that the job is to be given.
TYPED: Mapping[str, tuple[list[str], set[str]]] = {
    "capture": (["scan.obj"], {"scan"}),
    "model": (["model.npz"], {"model"}),
    "rig": (["rig.npz"], {"rig"}),
    "performance": (["frames.npy"], {"performance"}),
    "markers": (["take.c3d"], {"markers"}),
    "neutral": (["neutral.obj"], {"neutral"}),
    "captures": (["smile.obj"], set()),
}
ASKED: Mapping[str, list[tuple[list[str], dict[str, str]]]] = {
    "capture": [(["--landmarks", "landmarks.json"], {"landmarks": "landmarks.json"})],
    "neutral": [(["--neutral", "neutral.obj"], {"neutral": "neutral.obj"})],
    "model": [(["--person", "model.npz"], {"model": "model.npz"})],
    "any_rig": [(["--rig", "rig.npz"], {"rig": "rig.npz"})],
    "template": [(["--template", "template.npz"], {"template": "template.npz"})],
    "markers": [(["--set", "set.json"], {"marker_set": "set.json"})],
    "activations": [(["--activations", "emg.csv"], {"activations": "emg.csv"})],
    "blendshapes": [(["--blendshapes", "shapes.npz"], {"blendshapes": "shapes.npz"})],
    "expression_basis": [(["--basis", "basis.npz"], {"expression_basis": "basis.npz"})],
    "control_pairs": [(["--known", "pairs.npz"], {"control_pairs": "pairs.npz"})],
    "controls": [(["--controls", "controls.npz"], {"controls": "controls.npz"})],
    "fibre_muscles": [(["--fibres", "fibres.npz"], {"fibre_muscles": "fibres.npz"})],
    "live_skin": [(["--skin", "skin.npz"], {"live_skin": "skin.npz"})],
    "live_samples": [(["--samples", "samples.npz"], {"live_samples": "samples.npz"})],
    "live_takes": [(["--live", "takes.npz"], {"live_takes": "takes.npz"})],
    "marker_set": [(["--set", "set.json"], {"marker_set": "set.json"})],
    "texture": [(["--texture", "texture.png"], {"texture": "texture.png"})],
    "normals": [(["--normals", "normals.png"], {"normals": "normals.png"})],
    "wrinkles": [(["--wrinkle", "smile=wrinkles.png"], {})],
    "tracks": [(["--tracks", "tracks.npz"], {"tracks": "tracks.npz"})],
    "start": [(["--start", "rig.npz"], {"start": "rig.npz"})],
    "own_scans": [(["--scans", "smile.obj"], {})],
    "assets": [(["--asset", "soft=map.npy"], {})],
    "sequences": [],
    "signals": [],
    "photos": [
        (["--photo", "smile=face.jpg"], {}),
        (["--facts", "smile=face.json"], {}),
        (["--mask", "smile=mask.png"], {}),
        (["--film", "film.mov"], {"film": "film.mov"}),
    ],
    "role": [(["--role", "neutral"], {})],
}
NAMES = {name for words, _ in TYPED.values() for name in words} | {
    words[-1].partition("=")[2] or words[-1] for each in ASKED.values() for words, _ in each
}
SCENES: Mapping[str, Any] = {  # what they must have
    "animate": {"recording": {"asset": "take"}},
    "edit": {"edits": [{"kind": "stiffness", "factor": 0.5}]},
}


class CalledError(Exception):
    """Tell that a job was called, with its task."""

    def __init__(self, task: Task[Any]) -> None:
        super().__init__()
        self.task = task


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in with a file for every input, and jobs that only tell of their call."""

    def run(task: Task[Any]) -> None:
        raise CalledError(task)

    monkeypatch.setattr(jobs, "import_module", lambda _name: SimpleNamespace(run=run))
    monkeypatch.chdir(tmp_path)
    for name in NAMES:
        (tmp_path / name).write_text("{}")
    return tmp_path


def called(kind: Kind, more: list[str]) -> Task[Any]:
    """Type a kind's command with ``more``, and return the job's task."""
    words = [word for name in arguments(kind) for word in TYPED[name][0]]
    if "scene" in kind.schema["properties"]:
        Path("scene.json").write_text(json.dumps(SCENES.get(kind.name, {})))
        words.append("scene.json")
    command = kind.name.removeprefix("fit_").replace("_", "-")
    try:
        told = invoke(["solve", command, *words, "-o", "out", *more])
    except CalledError as call:
        return call.task
    pytest.fail(told.output)


def arguments(kind: Kind) -> list[str]:
    """Return the inputs of a kind that have no option's name."""
    named = {"neutral"} if "capture" in kind.reads else set()
    if "any_rig" in kind.reads:
        named.add("model")
    return [name for name in (*kind.reads, *kind.asks) if name in TYPED and name not in named]


def value_of(rules: Mapping[str, Any]) -> Any:
    """Return a value that an option's JSON Schema takes, other than its default."""
    forms = [rules, *rules.get("anyOf", ()), *rules.get("oneOf", ())]
    for each in forms:
        for value in each.get("enum", ()):
            if value not in (None, rules.get("default")):
                return value
    kinds = {kind for each in forms for kind in np.atleast_1d(each.get("type", []))}
    if "boolean" in kinds:
        return not rules["default"]
    if "object" in kinds:
        of = rules.get("additionalProperties")
        return {"side": value_of(of) if isinstance(of, dict) else 3}
    if "array" in kinds:
        return [value_of(rules["items"])] * rules.get("minItems", 1)
    if "string" in kinds:
        return "smile"
    least = rules.get("minimum", rules.get("exclusiveMinimum", 0))
    most = rules.get("maximum", least + 1000)
    value = 290 if least <= 290 <= most and rules.get("default") != 290 else (least + most) / 2
    return int(value) if "integer" in kinds else float(value)


OPTIONS = [
    pytest.param(kind, name, id=f"{kind.name}-{name}")
    for kind in KINDS.values()
    for name, rules in kind.schema["properties"].items()
    if "$ref" not in rules
]


@pytest.mark.parametrize(("kind", "name"), OPTIONS)
def test_an_option_reaches_the_job_and_nothing_else_changes(
    kind: Kind, name: str, folder: Path
) -> None:
    value = value_of(kind.schema["properties"][name])
    flag = f"--{name.replace('_', '-')}"
    typed = json.dumps(value) if isinstance(value, dict) else str(value)
    switches = {True: [flag], False: [flag.replace("--", "--no-", 1)]}
    plain = called(kind, [])
    task = called(kind, switches[value] if isinstance(value, bool) else [flag, typed])
    assert getattr(task.options, name) == value
    assert task.inputs == plain.inputs
    assert set(plain.inputs) == set().union(*(TYPED[each][1] for each in arguments(kind)))
    others = {"exclude": {name}}
    assert task.options.model_dump(**others) == plain.options.model_dump(**others)


INPUTS = [
    pytest.param(kind, words, files, id=f"{kind.name}-{words[0].strip('-')}")
    for kind in KINDS.values()
    for name in (*kind.reads, *kind.asks)
    for words, files in ASKED.get(name, ())
    if name not in arguments(kind) or name in {"capture", "markers"}
]


@pytest.mark.parametrize(("kind", "words", "files"), INPUTS)
def test_an_input_reaches_the_job_by_its_role(
    kind: Kind, words: list[str], files: dict[str, str], folder: Path
) -> None:
    plain = called(kind, [])
    task = called(kind, words)
    assert task.options == plain.options
    assert task.inputs == {**plain.inputs, **{role: Path(name) for role, name in files.items()}}
    if "--asset" in words:
        assert task.captures == {"soft": Path("map.npy")}
    if "--scans" in words:
        assert task.captures == {"smile": Path("smile.obj")}
    for flag, found, file in (
        ("--photo", task.captures, "face.jpg"),
        ("--wrinkle", task.captures, "wrinkles.png"),
        ("--facts", task.facts, "face.json"),
        ("--mask", task.masks, "mask.png"),
    ):
        assert (flag in words) == (found == {"smile": Path(file)})
    if "--role" in words:
        assert task.role == "neutral"


def test_a_model_is_an_option_where_a_rig_is_one() -> None:
    kind = replace(KINDS["fit_tracks"], reads=("any_rig", "model"))
    assert {part.parameter: part.is_needed for part in offline._parts(kind)} == {
        "rig": False,
        "person": False,
    }


def test_every_input_of_a_contract_is_typed_somewhere() -> None:
    named = {name for kind in KINDS.values() for name in (*kind.reads, *kind.asks)}
    assert named == {*TYPED, *ASKED}
