"""What axe (npm package ``axe-core``) finds wrong for keyboards, screen readers and weak eyes."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from solver.cache import cache_directory
from tests.service_client import Studio

pytestmark = pytest.mark.slow

LOCK = Path(__file__).parent / "axe"
NPM_TIMEOUT_S = 120


@pytest.fixture(scope="module")
def axe() -> str:
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("axe needs npm (apt-get install npm)")
    cache = cache_directory() / "axe"
    script = cache / "node_modules" / "axe-core" / "axe.min.js"
    if not script.exists():
        shutil.copytree(LOCK, cache, dirs_exist_ok=True)
        command = [npm, "ci", "--silent", "--no-audit", "--no-fund"]
        try:
            subprocess.run(command, cwd=cache, check=True, timeout=NPM_TIMEOUT_S)
        except (subprocess.SubprocessError, OSError) as error:
            pytest.skip(f"npm could not install axe: {error}")
    return script.read_text()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing(
    scheme: str, axe: str, show: Callable[..., Any], studio: Studio, context: Any
) -> None:
    subject_id = studio.modelled()
    smile = studio.capture(subject_id, "smile")
    bad = studio.raw(subject_id, "kiss", verdict="bad")
    check = studio.done("check_scan", subject_id, captures=[bad])["id"]
    fit = studio.done("fit_geometry", subject_id, captures=[smile])["id"]
    views = {
        "/": "tr[data-job]",
        "/upload": ".zone",
        "/subjects": "tbody a",
        f"/subjects/{subject_id}": "tbody tr",
        f"/jobs/{check}": ".findings",
        f"/jobs/{fit}": ".plot",
        "/rigs": "tbody a",
        "/health": ".notice",
        "/webhooks": ".empty",
        "/audit": "tbody a",
        "/sign-in": "tbody tr",
    }
    found = []
    for path, sign in views.items():
        page = show(path)
        page.emulate_media(color_scheme=scheme)
        page.locator(sign).first.wait_for()
        page.evaluate(axe)
        for fault in page.evaluate("async () => (await axe.run()).violations"):
            found.append((path, fault["id"], [node["html"] for node in fault["nodes"]][:3]))
        page.close()
    assert found == []
