"""A solver process that a stranger's file has taken over finds nothing, and leaves nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service_client import running
from worker import kernels, sandbox

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or bool(sandbox.missing_layers()),
    reason=f"this machine cannot confine a process: {'; '.join(sandbox.missing_layers())}",
)


def _tried(folder: Path, *, waits: bool) -> dict[str, str]:
    """Return what a solver process that was taken over tried, and what it got.

    ``waits``: the process was there before its job.
    """
    jobs = "tests.standin.taken_over"
    with running(folder, jobs=jobs, ingest_standby=waits) as (stack, studio):
        other = stack.settings.work / "other"
        other.mkdir(parents=True, exist_ok=True)
        (other / "scan").write_text("of another tenant")
        cache = stack.settings.work / "caches" / "default"
        cache.mkdir(parents=True)
        (cache / "meshed-4-there.npz").write_text("tets")
        subject = studio.subject()
        scan = studio.raw(subject, "smile")
        log = stack.settings.data_dir / "logs" / "ingest.log"
        for _ in range(20):  # until the process that waits has loaded its code
            done = studio.finished(studio.submit("check_scan", subject, captures=[scan]))
            if was_ready := log.read_text().rpartition("was_ready=")[2].startswith(str(waits)):
                break
        assert was_ready
        assert [each.read_text() for each in cache.iterdir()] == ["tets"]
    assert done["state"] == "succeeded", done
    got: dict[str, str] = done["result"]["summary"]["figures"]["got"]
    return got


@pytest.mark.parametrize("waits", [False, True])
def test_a_solver_that_is_taken_over_gets_nothing(
    waits: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "of the bucket")
    monkeypatch.setenv("STUDIO_TOKEN", "of somebody else")
    got = _tried(tmp_path, waits=waits)
    for name, found in got.items():
        sys.stdout.write(f"{name:34} {found or 'nothing'}\n")
    assert not any(got.values())


def test_kernels_are_read_from_the_installation_and_never_written_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    caching = pytest.importorskip("numba.core.caching")
    package = tmp_path / "solver" / "mechanics"
    attempt = tmp_path / "attempt"
    installed = package / "__pycache__" / "laws.energy-1.py311.nbi"
    installed.parent.mkdir(parents=True)
    file = caching.IndexDataCacheFile(str(installed.parent), "laws.energy-1.py311", "stamp")
    file.save("signature", "compiled")
    kept = installed.read_bytes()
    monkeypatch.setattr(kernels, "SOLVER", tmp_path / "solver")
    monkeypatch.delenv(kernels.KERNELS_VARIABLE, raising=False)
    kernels.link_kernels(attempt)
    home = attempt / caching._CacheLocator.get_suitable_cache_subpath(str(package / "laws.py"))
    file = caching.IndexDataCacheFile(str(home), "laws.energy-1.py311", "stamp")
    assert file.load("signature") == "compiled"
    file.save("signature", "poisoned")
    file.save("another", "poisoned")
    assert file.load("signature") == "poisoned"
    assert installed.read_bytes() == kept
    assert {each.name for each in installed.parent.iterdir()} == {
        "laws.energy-1.py311.nbi",
        "laws.energy-1.py311.1.nbc",
    }


def test_the_environment_of_a_solver_is_an_allow_list(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PGPASSWORD", "REDISCLI_AUTH", "GOOGLE_APPLICATION_CREDENTIALS", "STUDIO"):
        monkeypatch.setenv(name, "secret")
    seen = sandbox.allowed_environment(["STUDIO"])
    assert "secret" not in {value for name, value in seen.items() if name != "STUDIO"}
    assert seen["STUDIO"] == "secret"
    assert seen["PATH"] == os.environ["PATH"]


def test_the_memory_of_api_and_workers_is_their_own() -> None:
    code = (
        "import ctypes; from service.process import forbid_dumps; forbid_dumps();"
        "print(ctypes.CDLL(None).prctl(3, 0, 0, 0, 0))"  # PR_GET_DUMPABLE
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"
