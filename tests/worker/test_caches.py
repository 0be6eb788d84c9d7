"""A tenant's cache: written by supervisors alone, bounded, and never more than meshed templates."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service.settings import Settings
from worker import caches, kernels
from worker.caches import TenantCache


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TenantCache:
    installed = tmp_path / "installed"
    installed.mkdir()
    (installed / "template-1.npz").write_bytes(b"of the installation")
    monkeypatch.setenv("MYOFACE_CACHE", str(installed))
    return TenantCache("north", Settings(data_dir=tmp_path / "data", tenant_cache_bytes=100))


def _attempt(cache: TenantCache, tmp_path: Path, name: str) -> Path:
    folder = tmp_path / name
    cache.link_into(folder)
    return folder


def test_what_a_job_made_is_there_for_the_next_one(cache: TenantCache, tmp_path: Path) -> None:
    first = _attempt(cache, tmp_path, "first")
    (first / "meshed-4-abc-9mm.npz").write_bytes(b"tets")
    cache.keep_new(first)
    second = _attempt(cache, tmp_path, "second")
    assert (second / "meshed-4-abc-9mm.npz").read_bytes() == b"tets"
    assert (second / "template-1.npz").read_bytes() == b"of the installation"
    other = TenantCache("south", Settings(data_dir=tmp_path / "data"))
    assert not (_attempt(other, tmp_path, "other") / "meshed-4-abc-9mm.npz").exists()


def test_nothing_else_is_kept(cache: TenantCache, tmp_path: Path) -> None:
    attempt = _attempt(cache, tmp_path, "attempt")
    (attempt / "template-1.npz").unlink()
    (attempt / "template-1.npz").write_bytes(b"of a stranger")
    (attempt / "meshed-4-link.npz").symlink_to("/etc/passwd")
    (attempt / "meshed-4-folder.npz").mkdir()
    (attempt / "meshed-4-large.npz").write_bytes(bytes(101))
    os.mkfifo(attempt / "meshed-4-pipe.npz")
    cache.keep_new(attempt)
    assert list(cache.folder.iterdir()) == []
    elsewhere = tmp_path / "elsewhere"
    elsewhere.symlink_to(attempt)
    cache.keep_new(elsewhere)
    cache.keep_new(tmp_path / "missing")
    next_one = _attempt(cache, tmp_path, "next")
    assert (next_one / "template-1.npz").read_bytes() == b"of the installation"


def test_the_oldest_go_and_what_an_older_release_left(cache: TenantCache, tmp_path: Path) -> None:
    for age, name in enumerate(("new", "older", "oldest")):
        file = cache.folder / f"meshed-4-{name}.npz"
        file.write_bytes(bytes(40))
        os.utime(file, (time.time() - age, time.time() - age))
    (cache.folder / "anything").mkdir()
    (cache.folder / "template-1.npz").symlink_to("/etc/passwd")
    caches.trim_all(Settings(data_dir=tmp_path / "data", tenant_cache_bytes=100))
    assert {file.name for file in cache.folder.iterdir()} == {
        "meshed-4-new.npz",
        "meshed-4-older.npz",
    }


def test_no_more_is_kept_than_a_tenant_s_number_of_meshes(
    cache: TenantCache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(caches, "MOST_MESHES", 3)
    attempt = _attempt(cache, tmp_path, "attempt")
    for number in range(5):
        (attempt / f"meshed-4-{number}.npz").write_bytes(b"x")
        (attempt / f"meshed-5-{number}.npz").touch()
    cache.keep_new(attempt)
    assert len(list(cache.folder.iterdir())) == 3
    assert len(list(attempt.glob("meshed-4-*"))) == 2  # these were not even moved
    assert all(file.stat().st_size for file in cache.folder.iterdir())


def test_links_lead_somewhere_from_a_relative_folder(
    cache: TenantCache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MYOFACE_CACHE", "installed")
    attempt = _attempt(cache, tmp_path, "attempt")
    assert (attempt / "template-1.npz").read_bytes() == b"of the installation"
    monkeypatch.setenv(kernels.KERNELS_VARIABLE, "compiled")
    (tmp_path / "compiled" / "rig_1").mkdir(parents=True)
    (tmp_path / "compiled" / "rig_1" / "a.nbi").touch()
    kernels.link_kernels(tmp_path / "linked")
    assert (tmp_path / "linked" / "rig_1" / "a.nbi").is_file()


def test_a_worker_needs_no_numerics() -> None:
    code = "import sys, worker.process, worker.supervise; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
