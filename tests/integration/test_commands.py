"""The command line of a capture station against a running service."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

from myoface.cli.console import JUDGED
from myoface.client import Client
from myoface.client.credentials import KEY_VARIABLE
from myoface.stack import Stack
from service.settings import Settings
from tests.command_line import Told, invoke
from tests.service_client import Studio, served

Command = Callable[..., Told]


@pytest.fixture(scope="module")
def url(stack_and_studio: tuple[Stack, Studio]) -> Iterator[str]:
    stack, _ = stack_and_studio
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv(KEY_VARIABLE, stack.key)
        yield stack.url


@pytest.fixture
def myoface(url: str) -> Command:
    def run(*words: str | Path, code: int = 0) -> Told:
        done = invoke([*map(str, words), "--url", url])
        assert done.exit_code == code, done.output
        return done

    return run


def scan(folder: Path, name: str, *orders: str) -> Path:
    path = folder / f"{name}.obj"
    path.write_text("\n".join([f"# {name}", *(f"#! {order}" for order in orders)]))
    return path


def test_a_session_at_the_station(myoface: Command, url: str, tmp_path: Path) -> None:
    subject = myoface("subjects", "add", "Ada").output.strip()
    marks = tmp_path / "marks.csv"
    marks.write_text("nose,0,0,0")
    neutral = scan(tmp_path, "neutral")
    good = myoface(
        *("captures", "add", subject, neutral, "--neutral", "--raw", "--check"),
        *("--landmarks", marks, "--unit", "cm"),
    )
    assert "neutral: good" in good.output
    blink = scan(tmp_path, "blink", "verdict bad")
    bad = myoface("captures", "add", subject, blink, "--raw", "--check", code=3)
    assert "blink: bad: it cannot be used" in bad.output
    assert "blink.obj has no mouth" in bad.output
    assert "turn the head towards the lower camera and scan again" in bad.output
    myoface("captures", "delete", subject, "blink")

    frown = scan(tmp_path, "frown", "fault nan")
    smile = scan(tmp_path, "smile")
    myoface("captures", "add", subject, smile, frown, "--raw")
    registered = myoface("captures", "register", subject, "-o", tmp_path / "out", code=1).output
    assert registered.index("neutral: registered") < registered.index("smile: registered")
    mesh = (tmp_path / "out" / "smile" / "registered.ply").read_text()
    assert "neutral: registered, 83% of the face seen, 0.31 mm off the scan" in registered
    assert mesh == "registered # smile by registered # neutral by nose,0,0,0"
    assert "frown.obj has a NaN in line 3" in registered
    listed = myoface("jobs", "list", "--subject", subject, "--state", "failed").output
    failed = listed.splitlines()[1].split()[0]
    told = myoface("jobs", "download", failed, "-o", tmp_path / "none", code=1).output
    assert "the register_scan job failed and has left no files: frown.obj has a NaN" in told
    assert not (tmp_path / "none").exists()
    myoface("captures", "delete", subject, "frown")
    assert "no raw scan waits" in myoface("captures", "register", subject).output
    marks.write_text("nose,1,1,1")
    myoface("captures", "landmarks", subject, "neutral", marks)
    myoface("captures", "register", subject, "neutral")
    assert "from an earlier neutral" in myoface("captures", "list", subject).output
    again = myoface("captures", "register", subject).output
    assert "smile: registered" in again
    assert "neutral: registered" not in again

    rows = myoface("captures", "list", subject).output.splitlines()[1:]
    assert [row.split()[1:] for row in rows] == [
        ["smile", "expression", "raw,", "registered", "smile"],
        ["neutral", "neutral", "raw,", "registered", "good", "neutral"],
    ]
    job = myoface("jobs", "submit", "build_model", subject).output.split()[0]
    myoface("jobs", "download", job, "-o", tmp_path / "model")
    assert (tmp_path / "model" / "model.npz").exists()
    with Client(url) as client:
        checks = client.jobs(subject_id=subject, kind="check_scan")
        check = client.job(checks[-1].id)
    assert check.result is not None
    assert check.result.summary == {
        "verdict": "good",
        "findings": [],
        "figures": {
            "landmarks": "nose,0,0,0",
            "options": {"unit": "cm", "up": "auto", "forward": "auto", "role": "neutral"},
        },
    }


def test_a_check_ends_alike_here_and_at_a_service(
    myoface: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("solver.jobs.import_module", _standin)
    subject = myoface("subjects", "add", "Ada").output.strip()
    for kind, role, ending in (("check_markers", "markers", "trc"), ("check_scan", "raw", "obj")):
        for verdict, code in (("good", 0), ("usable", 0), ("bad", 3)):
            name = f"{role}_{verdict}"
            file = scan(tmp_path, name, f"verdict {verdict}").rename(tmp_path / f"{name}.{ending}")
            myoface("captures", "add", subject, file, f"--{role}")
            submit = ("jobs", "submit", kind, subject, "--capture", name)
            there = myoface(*submit, code=code).output
            job = there.split()[0]
            assert myoface("jobs", "wait", job, code=code).output in there
            here = invoke(["solve", kind.replace("_", "-"), str(file), "-o", str(tmp_path / name)])
            assert here.exit_code == code
            told = (
                here.output.replace(f"{tmp_path}/", "")
                .split(f"{name}.{ending}: ")[1]
                .splitlines()[:-1]
            )
            assert there.splitlines()[-len(told) :] == [f"{JUDGED[kind]}: {told[0]}", *told[1:]]
            assert len(told) == (1 if verdict == "good" else 3)


def _standin(name: str) -> ModuleType:
    return import_module(name.replace("solver.jobs", "tests.standin.jobs"))


def test_a_check_that_fails_keeps_no_other_back(myoface: Command, tmp_path: Path) -> None:
    subject = myoface("subjects", "add", "Ada").output.strip()
    frown = scan(tmp_path, "frown", "fault nan")
    smile = scan(tmp_path, "smile")
    told = myoface("captures", "add", subject, frown, smile, "--check", code=1).output
    assert "frown: frown.obj has a NaN in line 3" in told
    assert "smile: good" in told
    blink = scan(tmp_path, "blink", "verdict bad")
    myoface("captures", "add", subject, blink)
    assert "blink: bad" in myoface("captures", "check", subject, code=3).output


def test_a_performance_and_its_frames(myoface: Command, tmp_path: Path) -> None:
    subject = myoface("subjects", "add", "Ada").output.strip()
    myoface("upload", subject, scan(tmp_path, "neutral"), "--registered")
    myoface("upload", subject, scan(tmp_path, "smile"), "--registered")
    myoface("jobs", "submit", "build_model", subject)
    rig = myoface("jobs", "submit", "fit_geometry", subject).output.split()[-1]
    take = scan(tmp_path, "take", "frames 6").rename(tmp_path / "take.npy")
    myoface("captures", "add", subject, take, "--performance")
    given = ("fit_sequence", subject, "--rig", rig, "--capture", "take")
    job = myoface("jobs", "submit", *given).output.split()[0]
    lines = myoface("jobs", "frames", job, "--start", "2").output.splitlines()
    assert [json.loads(line)["frame"] for line in lines] == [2, 3, 4, 5]
    assert "neutral: good" in myoface("captures", "check", subject).output
    assert "performance  frames" in myoface("captures", "list", subject).output


def test_a_table_lies_beside_all_expressions_unless_some_are_named(
    myoface: Command, url: str, tmp_path: Path
) -> None:
    subject = myoface("subjects", "add", "Ada").output.strip()
    for name in ("neutral", "smile", "frown"):
        myoface("upload", subject, scan(tmp_path, name), "--registered")
    myoface("jobs", "submit", "build_model", subject)
    table = scan(tmp_path, "emg").rename(tmp_path / "emg.csv")
    emg = myoface("captures", "add", subject, table, "--role", "activations").output.split()[0]
    fits = []
    for named, expressions in (((), {"smile", "frown"}), (("--capture", "smile"), {"smile"})):
        given = ("fit_geometry", subject, "--capture", "emg", *named)
        fits.append(told := myoface("jobs", "submit", *given).output.split())
        with Client(url) as client:
            assert set(client.rig(told[-1]).expressions) == expressions
    with Client(url) as client:
        assert {job.id for job in client.jobs(reads=emg)} == {told[0] for told in fits}


def test_an_unknown_name_is_refused_with_those_there_are(myoface: Command, tmp_path: Path) -> None:
    subject = myoface("subjects", "add", "Ada").output.strip()
    myoface("upload", subject, scan(tmp_path, "smile"))
    refused = myoface("captures", "delete", subject, "smiel", code=2)
    assert "the subject's captures, which are smile" in refused.output


def test_the_kinds_of_job_and_their_options(myoface: Command) -> None:
    assert "build_model" in myoface("jobs", "kinds").output
    line, other = myoface("jobs", "kinds", "build_model").output.splitlines()[1:]
    assert other.split()[:2] == ["muscles", '"compartments"']
    assert line.split(maxsplit=6) == [
        *("edge_mm", "9.0", ">=", "3,", "<=", "30"),
        "edge length of the tetrahedra",
    ]
    assert "fit_geometry" in myoface("jobs", "kinds", "fit_nothing", code=2).output


def test_keys_at_the_command_line(myoface: Command, url: str) -> None:
    text = myoface("keys", "add", "station 2", "--scope", "read", "--scope", "write").output.strip()
    assert text.startswith("myo_")
    listed = myoface("keys", "list").output
    assert "station 2  read,write" in listed
    key_id = text[4:16]
    fresh = myoface("keys", "rotate", key_id, "--grace", "0").output.strip()
    myoface("keys", "revoke", fresh[4:16])
    assert "key.revoked" in myoface("keys", "audit", "--about", fresh[4:16]).output
    assert "stored bytes" in myoface("keys", "whoami").output


def test_a_tenant_is_added_with_its_first_key(tmp_path: Path) -> None:
    def run(*words: str, code: int = 0) -> str:
        done = invoke([*words, "--data", str(tmp_path)])
        assert done.exit_code == code, done.output
        return done.output

    key = tmp_path / "first.key"
    tenant = run("tenants", "add", "North", "--key", str(key), "--max-queued", "5").strip()
    assert key.stat().st_mode & 0o777 == 0o600
    run("tenants", "add", "South", "--key", str(key), code=2)
    assert f"{tenant}  North           5" in run("tenants", "list")
    run("tenants", "limit", tenant, "--max-bytes", "1000")
    assert f"{tenant}  North    1000" in run("tenants", "list")
    run("tenants", "retain", tenant, "--scans", "30", "--jobs", "7")
    run("tenants", "retain", tenant, "--jobs", "none", "--rigs", "60")  # the scans' stay
    run("tenants", "retain", tenant, code=2)
    for text in ("0", "soon", "-3"):
        run("tenants", "retain", tenant, "--scans", text, code=2)
    run("tenants", "retain", "nobody", "--scans", "30", code=2)
    with served(Settings(data_dir=tmp_path, host="127.0.0.1")) as studio:
        north = Studio(studio.http, key.read_text())
        assert north.get("/v1/me")["tenant"] == "North"
        assert north.get("/v1/usage")["bytes"]["limit"] == 1000
        kept = north.get("/v1/limits")["retention"]
        assert kept == {"subjects": None, "scans": 30, "jobs": None, "rigs": 60, "audit": None}


def test_a_tenant_that_lost_its_key_is_given_another(tmp_path: Path) -> None:
    def run(*words: str, code: int = 0) -> str:
        done = invoke(["tenants", *words, "--data", str(tmp_path)])
        assert done.exit_code == code, done.output
        return done.output

    first = tmp_path / "first.key"
    second = tmp_path / "second.key"
    tenant = run("add", "North", "--key", str(first)).strip()
    run("key", tenant, "--key", str(first), code=2)
    run("key", "nobody", "--key", str(second), code=2)
    assert not second.exists()
    run("key", tenant, "--key", str(second))
    assert second.stat().st_mode & 0o777 == 0o600
    with served(Settings(data_dir=tmp_path, host="127.0.0.1")) as studio:
        north = Studio(studio.http, second.read_text())
        me = north.get("/v1/me")
        assert me["tenant"] == "North"
        assert "metrics" not in me["scopes"]
        made = north.get(f"/v1/audit?object_id={me['key_id']}")["items"]
        assert [(each["action"], each["key_id"]) for each in made] == [("key.created", "operator")]
        lost = first.read_text().split("_")[1][:12]
        assert north.http.delete(f"/v1/keys/{lost}").status_code == 204


def test_ids_are_known_by_their_start_and_people_by_their_name(
    myoface: Command, tmp_path: Path
) -> None:
    one, two, grace = (
        myoface("subjects", "add", name).output.strip() for name in ("Twin", "Twin", "Grace H")
    )
    myoface("upload", "grace h", scan(tmp_path, "smile"))
    assert "smile" in myoface("captures", "list", grace[:6]).output
    told = myoface("captures", "list", "Twin", code=2).output
    assert one in told
    assert two in told
    for unknown in (grace[:5], "Nobody", "   "):
        assert "there is no subject" in myoface("captures", "list", unknown, code=2).output
    myoface("captures", "check", "Grace H")
    job = myoface("jobs", "list", "--subject", "Grace H").output.splitlines()[1].split()[0]
    myoface("jobs", "download", job[:8], "-o", tmp_path / "check")
    assert (tmp_path / "check" / "check.json").exists()


def test_a_batch_has_units_landmarks_and_options(
    myoface: Command, url: str, tmp_path: Path
) -> None:
    neutral = scan(tmp_path, "neutral")
    smile = scan(tmp_path, "a smile")
    marks = tmp_path / "marks.csv"
    marks.write_text("nose,0,0,0")
    given = ("--person", "Ada B", "--unit", "cm", "--up", "-z", "--landmarks", f"neutral={marks}")
    fit = '{"register_scan": {"unit": "inch"}}'
    told = myoface("batches", "add", neutral, smile, *given, "--options", fit, "--then", "register")
    assert "a_smile  expression  good   succeeded" in told.output
    with Client(url) as client:
        listed = client.jobs(subject_id=told.output.split()[-1])
        jobs = [client.job(each.id) for each in listed]
    found = {job.kind: job.result.summary for job in jobs if job.result}
    assert found["check_scan"]["figures"]["options"]["unit"] == "cm"
    assert found["check_scan"]["figures"]["options"]["up"] == "-z"
    assert any("nose,0,0,0" in str(job.result) for job in jobs)
    for wrong in ("marks.csv", "kiss=marks.csv", "neutral=gone.csv"):
        given = ("--person", "Ada B", "--landmarks", wrong)
        assert "SCAN=FILE" in myoface("batches", "add", neutral, *given, code=2).output


def test_a_rig_is_fetched_whole_packed_and_for_other_programs(
    myoface: Command, tmp_path: Path
) -> None:
    scans = (scan(tmp_path, "neutral"), scan(tmp_path, "smile"))
    told = myoface("batches", "add", *scans, "--person", "Grace H2")
    rig = told.output.split()[-1]
    folder = tmp_path / "rig"
    told = myoface("rigs", "download", rig[:8], "-o", folder)
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"rig.npz", "model.npz", "rig.json"} <= files.keys()
    assert {Path(line).name for line in told.output.split() if "/" in line} == files.keys()
    myoface("rigs", "download", rig[:8], "-o", folder, "--zip")
    with zipfile.ZipFile(tmp_path / "rig.zip") as packed:
        assert {name: packed.read(name) for name in packed.namelist()} == files

    assert "export_rig" not in myoface("jobs", "list").output
    myoface("export", rig[:8], "--format", "glb", "-o", tmp_path / "out")
    assert (tmp_path / "out" / "rig.glb").read_bytes() == files["rig.glb"]
    assert "export_rig" not in myoface("jobs", "list").output  # it was there
    myoface("export", rig[:8], "-o", tmp_path / "out")
    assert (tmp_path / "out" / "rig.usdc").read_text() == "usd of smile"
    assert "there is no file nothing.npz" in myoface("export", "nothing.npz", code=2).output


def test_names_are_refused_before_anything_is_sent(myoface: Command, tmp_path: Path) -> None:
    subject = myoface("subjects", "add", "Ida").output.strip()
    twins = [scan(tmp_path, "smile 1"), scan(tmp_path, "smile_1")]
    told = myoface("upload", subject, *twins, code=1).output
    assert "would both be called smile_1" in told
    told = myoface("upload", subject, scan(tmp_path, "   "), code=1).output
    assert "no name can be made of" in told
    assert len(myoface("captures", "list", subject).output.splitlines()) == 1
    myoface("upload", subject, tmp_path / "   .obj", "--name", "Größer 1")
    assert "Grosser_1  expression  raw" in myoface("captures", "list", subject).output


def test_what_is_there_is_not_sent_again(myoface: Command, tmp_path: Path) -> None:
    subject = myoface("subjects", "add", "Eve").output.strip()
    smile = scan(tmp_path, "smile")
    frown = scan(tmp_path, "frown")
    first = myoface("captures", "add", subject, smile).output
    both = myoface("captures", "add", subject, smile, frown).output
    assert both.startswith(first)
    again = scan(tmp_path, "smile", "verdict bad")
    assert "capture.name_taken" in myoface("captures", "add", subject, again, code=1).output
    replaced = myoface("captures", "add", subject, again, "--replace").output
    assert replaced.split()[1:] == first.split()[1:]
    assert replaced != first
    assert len(myoface("captures", "list", subject).output.splitlines()) == 3


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--unit", "0"), "argument --unit: '0' is not one of auto, mm"),
        (("--unit", "furlong"), "argument --unit: 'furlong' is not one of auto, mm"),
        (("--forward", "up"), "argument --forward: invalid choice: 'up'"),
        (("--unit", "cm"), "--unit, --eye-distance, --up and --forward need --check"),
        (("--eye-distance", "62"), "need --check"),
        (("--up", "z"), "need --check"),
        (("--nothing",), "unrecognized arguments: --nothing"),
    ],
)
def test_an_option_that_is_wrong_is_named(
    words: tuple[str, ...], told: str, tmp_path: Path
) -> None:
    command = ["upload", "Ada", str(scan(tmp_path, "smile")), *words]
    done = invoke([*command, "--url", "http://127.0.0.1:9"])
    assert done.exit_code == 2
    assert told in done.output


def test_webhooks_at_the_command_line(myoface: Command) -> None:
    address = "https://hooks.studio.example/myoface"
    made, secret = myoface("webhooks", "add", address, "--event", "job.succeeded").output.split()
    assert secret.startswith("whsec_")
    assert f"{made}  {address}  job.succeeded  all    on" in myoface("webhooks", "list").output
    myoface("webhooks", "change", made[:8], "--no-active", "--kind", "fit_geometry")
    assert "fit_geometry  off: by_user" in myoface("webhooks", "list").output
    fresh = myoface("webhooks", "rotate", address).output.strip()
    assert fresh.startswith("whsec_")
    assert fresh != secret
    assert "delivery" in myoface("webhooks", "deliveries", made).output
    myoface("webhooks", "delete", made)
    assert address not in myoface("webhooks", "list").output


def test_things_are_called_and_found_as_the_studio_likes(myoface: Command, tmp_path: Path) -> None:
    subject = myoface("subjects", "add", "Ada M.", "--label", "session:Monday 17").output.strip()
    neutral = scan(tmp_path, "Großes Lächeln")
    myoface("captures", "add", "Ada M.", neutral, "--label", "take: 1")
    (row,) = myoface("captures", "list", subject).output.splitlines()[1:]
    assert " ".join(row.split()[1:]) == "Grosses_Lacheln expression raw Großes Lächeln take:1"
    edit = ("captures", "edit", subject, "Grosses_Lacheln")
    edited = myoface(*edit, "--name", "  Ruhe 1 ", "--title", "Ruhe", "--role", "neutral")
    assert edited.output.split()[1:] == ["Ruhe_1", "neutral"]
    myoface("captures", "edit", subject, "ruhe_1", "--label", "camera:left", "--unlabel", "take")
    (row,) = myoface("captures", "list", subject, "--label", "camera:left").output.splitlines()[1:]
    assert row.split()[1:] == ["Ruhe_1", "neutral", "raw", "Ruhe", "camera:left"]
    assert len(myoface("captures", "list", subject, "--label", "take:1").output.splitlines()) == 1
    myoface("subjects", "edit", subject, "--name", "Ada Neumann", "--label", "session:Tuesday")
    (row,) = myoface("captures", "list", subject, "--label", "camera").output.splitlines()[1:]
    assert len(myoface("captures", "list", subject, "--label", "take").output.splitlines()) == 1
    listed = myoface("subjects", "list", "--label", "session:Tuesday").output.splitlines()[1:]
    assert [row.split()[1:3] for row in listed] == [["Ada", "Neumann"]]
    edit = ("captures", "edit", subject, "ruhe_1")
    for wrong, words in (
        ((*edit, "--name", "  "), "no letter of a to z"),
        ((*edit, "--name", "nul.obj"), "a device's name on Windows"),
        (edit, "nothing is to be changed"),
        ((*edit, "--label", "camera"), "KEY:VALUE is expected"),
        ((*edit, "--label", ":left"), "KEY:VALUE is expected"),
    ):
        assert words in myoface(*wrong, code=2).output


def test_a_scan_that_is_said_to_be_registered_is_counted_first(
    myoface: Command, tmp_path: Path
) -> None:
    subject = myoface("subjects", "add", "Ida").output.strip()
    obj = tmp_path / "neutral.obj"
    ply = tmp_path / "smile.ply"
    obj.write_text("v 0 0 0\n" * 12 + "vn 0 0 1\n")
    ply.write_text("ply\nformat ascii 1.0\nelement vertex 13\nproperty float x\nend_header\n")
    for file, count in ((obj, 12), (ply, 13)):
        told = myoface("captures", "add", subject, file, "--registered", code=1).output
        assert f"{file.name} has {count} vertices" in told
        assert "4866: send it as it is (without --registered)" in told
        told = myoface("batches", "add", file, "--subject", subject, "--registered", code=1).output
        assert "client.topology" in told
    assert len(myoface("captures", "list", subject).output.splitlines()) == 1
    whole = tmp_path / "whole.obj"
    whole.write_text("v 0 0 0\n" * 4866)
    myoface("captures", "add", subject, whole, "--registered")


def test_lists_show_person_date_verdict_and_duration(myoface: Command, tmp_path: Path) -> None:
    subject = myoface("subjects", "add", "Eva Maria").output.strip()
    myoface("captures", "add", subject, scan(tmp_path, "neutral"), "--check")
    head, row = myoface("jobs", "list", "--subject", subject).output.splitlines()
    assert head.split() == ["job", "person", "kind", "state", "verdict", "date", "took", "stand"]
    _, *words = row.split()
    assert words[:5] == ["Eva", "Maria", "check_scan", "succeeded", "good"]
    assert words[-1] == "s"
    head, *rows = myoface("rigs", "list", "--subject", subject).output.splitlines()
    assert " ".join(head.split()) == "rig name person verdict date took expressions labels"
    assert rows == []
