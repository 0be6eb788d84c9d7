"""A rig of a service, downloaded by one command, is all that documents and commands need.

Every snippet of README, the researcher's guide and the notebook runs on it, without the service.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from myoface.client import Client
from myoface.stack import Stack
from service.settings import Settings
from solver.model import SubjectModel
from solver.rig import Rig
from solver.templates.builtin.build import builtin_capture_set
from tests.command_line import invoke
from tests.fixtures import JAX_FOLDER, jax_module

ROOT = Path(__file__).parents[2]
GUIDES = ROOT / "docs" / "guide"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that one command filled with a coarse rig of a service, now stopped."""
    place = tmp_path_factory.mktemp("rig")
    scans = builtin_capture_set().first(2, 0).write(place / "scans")
    settings = Settings(data_dir=place / "service", port=0)
    with Stack(settings) as stack, Client(stack.url, stack.key) as client:
        subject = client.create_subject("Ada")
        ids = {
            name: client.add_capture(
                subject.id,
                path,
                role="neutral" if name == "neutral" else "expression",
                registered=True,
            ).id
            for name, path in scans.items()
        }
        client.run("build_model", subject.id, options={"edge_mm": 16.0})
        neutral = ids.pop("neutral")
        assert neutral
        captures = list(ids.values())
        job = client.run("fit_geometry", subject.id, captures=captures, options={"rounds": 2})
        assert job.result is not None
        assert job.result.rig_id is not None
        known = {"MYOFACE_URL": stack.url, "MYOFACE_API_KEY": stack.key}
        done = invoke(["rigs", "download", job.result.rig_id[:8], "-o", str(place / "rig")], known)
        assert done.exit_code == 0, done.output
    return place / "rig"


def readme() -> str:
    return _python(ROOT / "README.md")


def guide() -> str:
    return _python(ROOT / "docs" / "science" / "researcher.md")


def guide_in_jax() -> str:
    """Return the guide with its snippet of JAX, which is an extra."""
    jax_module()
    return _python(ROOT / "docs" / "science" / "researcher.md", fences="python|py")


def _python(document: Path, fences: str = "python") -> str:
    text = document.read_text(encoding="utf-8")
    return "\n".join(re.findall(rf"```(?:{fences})\n(.*?)```", text, re.DOTALL))


def fibres() -> str:
    """Return the guide to fibre muscles, after what it takes for granted; the face has a rest."""
    begin = """
from pathlib import Path
from solver import Rig
from solver.fitting.calibration import fibre_muscles, save_muscles
from solver.fitting.face import Face
from solver.mechanics.flesh import MOONEY_RIVLIN

model, path = Rig.load("demo-output").model, Path("fibre_muscles.npz")
made = Face(model, material=MOONEY_RIVLIN)
save_muscles(path, made, fibre_muscles(made))
"""
    return (
        begin
        + _python(GUIDES / "fibre-muscles.md")
        + "face.solve_equilibrium(face.rest.pose, face.rest.x)\n"
    )


def anatomy() -> str:
    return _python(GUIDES / "builtin-anatomy.md")


def notebook() -> str:
    cells = json.loads(
        (ROOT / "docs" / "examples" / "researcher.ipynb").read_text(encoding="utf-8")
    )["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


@pytest.mark.parametrize(
    "script",
    [readme, guide, guide_in_jax, fibres, anatomy, notebook],
    ids=lambda script: script.__name__,
)
def test_the_snippets_run(script: Callable[[], str], rig: Path, tmp_path: Path) -> None:
    shutil.copytree(rig, tmp_path / "demo-output")
    code = script()
    assert code.count("\n") > 7
    run(code, cwd=tmp_path)


def run(code: str, *words: str | Path, cwd: Path) -> str:
    """Run Python in a folder, with nothing that leads to a service."""
    child = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=cwd,
        env={
            "PYTHONPATH": f"{ROOT}:{JAX_FOLDER}",
            "PATH": "/usr/bin:/bin",
            "HOME": str(Path.home()),
        },
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert child.returncode == 0, child.stdout + child.stderr
    return child.stdout


def test_the_folder_is_complete(rig: Path) -> None:
    note = json.loads((rig / "rig.json").read_text())
    assert note["subject"]["name"] == "Ada"
    assert {each["kind"] for each in note["artifacts"]} == {"build_model", "fit_geometry"}
    names = {each["name"] for each in note["artifacts"]}
    assert {path.name for path in rig.iterdir()} == {*names, "rig.json"}
    assert names >= {"rig.npz", "rig.glb", "model.npz", "report.html", "view.bin"}
    made = Rig.load(rig)
    report = json.loads((rig / "report.json").read_text())
    assert report["made_with"]["template"]["name"] == made.model.template["name"]
    assert report["made_with"]["model_sha256"] == made.model.sha256
    assert SubjectModel.load(rig / "model.npz").sha256 == made.model.sha256


def test_the_service_has_written_usd(rig: Path) -> None:
    pxr = pytest.importorskip("pxr.Usd", reason="USD is not installed: pip install 'myoface[usd]'")
    from tests.dcc.test_usd import faults

    stage = pxr.Stage.Open(str(rig / "rig.usdc"))
    assert faults(stage) == []
    assert stage.GetPrimAtPath("/Face/Skin/smile").IsValid()


COMMAND = "from myoface.cli import main; main()"


@pytest.mark.parametrize("format", ["usd", "glb", "npz"])
def test_it_is_exported_here(rig: Path, tmp_path: Path, format: str) -> None:
    if format == "usd":
        pytest.importorskip("pxr", reason="USD is not installed: pip install 'myoface[usd]'")
    run(COMMAND, "export", rig, "--format", format, "-o", tmp_path / "out", cwd=tmp_path)
    file = {"usd": "rig.usdc", "glb": "rig.glb", "npz": "rig.npz"}[format]
    assert (tmp_path / "out" / file).stat().st_size > 10_000


SCENE = {
    "duration": 0.1,
    "fps": 20,
    "keys": [{"time": 0.0}, {"time": 0.1, "expressions": {"smile": 0.5}}],
}


def test_commands_without_a_service_take_the_folder(rig: Path, tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(json.dumps(SCENE))
    told = run(COMMAND, "solve", "simulate", rig, "scene.json", "-o", "played", cwd=tmp_path)
    assert "0 inverted" in told
    assert (tmp_path / "played" / "animation.glb").stat().st_size > 10_000
    smile = sorted((rig.parent / "scans").glob("smile*"))[0]
    words = ("solve", "activations", rig, smile, "-o", "fitted")
    run(COMMAND, *words, cwd=tmp_path)
    again = Rig.load(tmp_path / "fitted").expressions
    assert [each.name for each in again if each.name == "smile"] == ["smile"]
