"""Words of a command line and the parameters that they become."""

from __future__ import annotations

import json
import types
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from myoface import cli
from myoface.cli.app import read_object, read_unit, scan_frame
from myoface.cli.batches import batches, landmarks_of, with_frame
from myoface.cli.captures import captures
from myoface.cli.commands import Argument, Command, Group, Option, UsageError
from myoface.cli.lookup import matching
from myoface.errors import ApiError
from myoface.names import name_session
from myoface.resources import Subject
from tests.command_line import invoke

DEFAULTS: dict[str, Any] = {
    "subject": "Ada",
    "files": [],
    "axis": "auto",
    "count": 3,
    "label": None,
    "wait": True,
    "force": False,
    "url": "http://here",
}


def read(words: str) -> dict[str, Any]:
    """Return what a command is called with."""
    found: dict[str, Any] = {}

    def command(
        subject: str,
        files: Annotated[list[Path] | None, Argument()] = None,
        axis: Annotated[Literal["auto", "y", "-y"], Option()] = "auto",
        count: Annotated[int, Option("--count", "-n", min=0, max=9)] = 3,
        label: Annotated[list[str] | None, Option()] = None,
        wait: bool = True,
        force: Annotated[bool, Option("--force")] = False,
        url: Annotated[str, Option(envvar="TEST_URL")] = "http://here",
    ) -> None:
        found.update(locals())

    Command(command, "").run(words.split(), "test")
    return {name: value for name, value in found.items() if name in DEFAULTS}


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ("Ada", {}),
        ("Ada a.obj b.obj", {"files": [Path("a.obj"), Path("b.obj")]}),
        ("Ada --axis -y a.obj", {"axis": "-y", "files": [Path("a.obj")]}),
        ("--axis=-y Ada", {"axis": "-y"}),
        ("Ada -n 0", {"count": 0}),
        ("Ada a.obj --count 9 b.obj", {"count": 9, "files": [Path("a.obj"), Path("b.obj")]}),
        ("Ada --label x --label -y", {"label": ["x", "-y"]}),
        ("Ada --no-wait --force", {"wait": False, "force": True}),
        ("Ada -- --axis -y", {"files": [Path("--axis"), Path("-y")]}),
        ("--force -- Ada -x", {"force": True, "files": [Path("-x")]}),
        ("Ada --url http://there", {"url": "http://there"}),
    ],
)
def test_words_become_parameters(words: str, given: dict[str, Any]) -> None:
    assert read(words) == {**DEFAULTS, **given}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "required: SUBJECT"),
        ("Ada --count x", "'x' is no whole number"),
        ("Ada --count 10", "10 is more than 9"),
        ("Ada --count -1", "-1 is less than 0"),
        ("Ada --axis z", "invalid choice: 'z'"),
        ("Ada --axis", "expected one argument"),
        ("Ada --forc", "unrecognized arguments: --forc"),
    ],
)
def test_words_that_cannot_be_followed_are_told(words: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        read(words)


def test_a_variable_stands_in_for_an_option_unless_it_is_empty(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TEST_URL", "http://there")
    assert read("Ada")["url"] == "http://there"
    monkeypatch.setenv("TEST_URL", "")
    assert read("Ada")["url"] == "http://here"


def test_a_file_that_cannot_be_read_is_no_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = tmp_path / "a.obj"
    scan.touch()

    def command(file: Annotated[Path, Argument(exists=True)]) -> None:
        raise AssertionError(file)

    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(UsageError, match="cannot be read"):
        Command(command, "").run([str(scan)], "test")
    with pytest.raises(UsageError, match="too long"):
        Command(command, "").run(["x" * 5000], "test")


def test_options_come_after_the_command() -> None:
    told = invoke(["--url", "http://x", "subjects", "list"])
    assert told.exit_code == 2
    assert "options come after the command" in told.stderr
    assert "--version" in invoke(["--help"]).stdout


def test_windows_has_wildcards_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("b.obj", "a.obj", "c.txt"):
        (tmp_path / name).touch()
    words = ["add", "*.obj", "?.txt", "*.stl", '{"a": "*"}']
    monkeypatch.chdir(tmp_path)
    assert cli.expand_wildcards(words) == words
    monkeypatch.setattr(cli, "os", types.SimpleNamespace(name="nt"))
    assert cli.expand_wildcards(words) == ["add", "a.obj", "b.obj", "c.txt", "*.stl", '{"a": "*"}']


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        (FileNotFoundError(2, "No such file or directory", "gone.obj"), "gone.obj: No such file"),
        (OSError(28, "No space left on device"), "error: No space left"),
    ],
)
def test_a_fault_of_a_file_is_a_line(
    fault: OSError, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = Group("")

    @group.command()
    def fail() -> None:
        raise fault

    monkeypatch.setitem(cli.app.members, "fail", group.members["fail"])
    told = invoke(["fail"])
    assert told.exit_code == 1
    assert line in told.stderr
    assert "Traceback" not in told.stderr


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("name", "NAME: "),
        ("url", "ADDRESS: "),
        ("events[0]", "--event [0]: "),
        ("options.check_scan.unit", "--unit: "),
        ("options.check_scan.eye_distance_mm", "--eye-distance: "),
        ("options.scene.keys[0].time", "--scene keys[0].time: "),
        ("options.fit_geometry.rounds", "--options fit_geometry.rounds: "),
        ("template_id", "--template: "),
        ("other", "other: "),
    ],
)
def test_a_refusal_names_the_option_or_argument(
    where: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = Group("")

    @group.command()
    def ask(
        name: str,
        address: str,
        event: Annotated[list[str] | None, Option()] = None,
        unit: str = "auto",
        eye_distance: float | None = None,
        scene: Path | None = None,
        options: str = "{}",
        template: str | None = None,
        url: str = "http://here",
    ) -> None:
        faults = [{"where": where, "message": "no"}]
        raise ApiError({"code": "request.invalid", "detail": f"{where}: no", "errors": faults})

    monkeypatch.setitem(cli.app.members, "ask", group.members["ask"])
    assert f"error: {said}no (request.invalid)" in invoke(["ask", "x", "y"]).stderr


def test_an_object_is_given_itself_or_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "options.json"
    file.write_text(json.dumps({"name": "Zoë"}, ensure_ascii=False), encoding="utf-8-sig")
    assert read_object(f"@{file}", "--options") == {"name": "Zoë"}
    for wrong, said in (
        (f"@{file}x", "No such file"),
        ("[1]", "must be a JSON object"),
        ("{", "is not JSON"),
    ):
        with pytest.raises(UsageError, match=said):
            read_object(wrong, "--options")


def test_options_of_a_batch_are_those_of_its_jobs() -> None:
    frame = {"unit": "cm", "up": "auto"}
    given = {"register_scan": {"unit": "mm", "rounds": 2}, "fit_geometry": {}}
    assert with_frame(given, ["check_scan", "register_scan"], frame) == {
        "check_scan": frame,
        "register_scan": {**frame, "unit": "mm", "rounds": 2},
        "fit_geometry": {},
    }
    with pytest.raises(UsageError, match="check_scan must be a JSON object"):
        with_frame({"check_scan": 3}, ["check_scan"], frame)


def test_a_scan_has_a_unit_by_name_or_number_or_the_distance_of_its_eyes() -> None:
    assert [read_unit(word) for word in ("inch", "0.0437", "30")] == ["inch", 0.0437, 30.0]
    for wrong in ("mile", "0", "-3", "nan", "inf", "22,9"):
        with pytest.raises(ValueError, match="nor a number of mm above 0"):
            read_unit(wrong)
    assert scan_frame(22.9, None, "z", "auto") == {"unit": 22.9, "up": "z", "forward": "auto"}
    eyes = scan_frame("auto", 62.0, "z", "auto")
    assert eyes == {"eye_distance_mm": 62.0, "up": "z", "forward": "auto"}
    with pytest.raises(UsageError, match="not both"):
        scan_frame("cm", 62.0, "auto", "auto")


@pytest.mark.parametrize("wrong", ["nan", "0", "-62", "inf", "620"])
def test_an_eye_distance_is_a_persons(wrong: str, tmp_path: Path) -> None:
    scan = tmp_path / "neutral.obj"
    scan.touch()
    words = {"check": ["Ada"], "register": ["Ada"], "add": ["Ada", str(scan)]}
    commands = [(captures.members[name], each) for name, each in words.items()]
    for command, given in [*commands, (batches.members["add"], [str(scan)])]:
        assert isinstance(command, Command)
        with pytest.raises(UsageError, match="--eye-distance"):
            command.parser("here").parse_args([*given, f"--eye-distance={wrong}"])


def test_landmarks_are_of_a_scan_that_is_named_twice(tmp_path: Path) -> None:
    scan = tmp_path / "neutral.obj"
    marks = tmp_path / "neutral.csv"
    marks.touch()
    assert landmarks_of([f"neutral={marks}"], name_session(scan, [scan])) == {scan.resolve(): marks}


def test_a_name_that_is_meant_exactly_comes_first() -> None:
    people = [Subject(id="1" * 8, name="ada"), Subject(id="2" * 8, name="Ada")]
    assert matching("Ada", people, lambda each: each.name) == people[1:]
    assert matching("ADA", people, lambda each: each.name) == people
    assert matching("222222", people, lambda each: each.name) == people[1:]


def test_landmarks_are_of_a_scan_by_its_file_its_name_or_its_role(tmp_path: Path) -> None:
    paths = [tmp_path / "James Neutral 01.obj", tmp_path / "James Smile 02.obj"]
    marks = tmp_path / "marks.csv"
    marks.write_text("nose_tip,0,0,0")
    scans = name_session(None, paths)
    for scan in ("neutral", "Neutral_01", "James Neutral 01.obj", "James Neutral 01"):
        assert landmarks_of([f"{scan}={marks}"], scans) == {paths[0].resolve(): marks}
    with pytest.raises(UsageError, match="one of the scans, which are Neutral_01, Smile_02"):
        landmarks_of([f"kiss={marks}"], scans)
    with pytest.raises(UsageError, match=r"'gone\.csv' is no file"):
        landmarks_of(["neutral=gone.csv"], scans)


def test_help_says_the_address_that_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MYOFACE_URL", "https://faces.example.com")
    told = invoke(["subjects", "list", "--help"]).output
    assert "https://faces.example.com" in told
