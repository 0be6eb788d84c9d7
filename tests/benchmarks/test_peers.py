from __future__ import annotations

import argparse
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from benchmarks import documents, environments, peers, report
from benchmarks.environments import UnavailableError, environment
from benchmarks.forward.child import gradient_error
from benchmarks.forward.ours import Ours
from benchmarks.forward.problem import Problem, active, block, energy, passive
from benchmarks.peers import Answer

CELLS = (6, 4, 2)


@pytest.mark.parametrize("problem", [active(CELLS), passive(CELLS)], ids=["active", "passive"])
def test_the_energy_that_measures_is_the_one_that_is_solved(problem: Problem) -> None:
    ours = Ours(asdict(problem))
    x, _, _ = ours.solve()
    solved = energy(problem, x, polar_of_f=False)
    assert solved == pytest.approx(ours.energy(x), rel=1e-12)
    assert solved < energy(problem, problem.start, polar_of_f=False)
    # polar(F) is not the best rotation where flesh is active
    excess = energy(problem, x, polar_of_f=True) / solved - 1.0
    assert excess > 1e-4 if problem.a.std(axis=0).any() else abs(excess) < 1e-12
    held = np.isin(np.arange(len(x)), problem.held)
    assert np.array_equal(x[held], problem.start[held])
    assert gradient_error(ours, problem.start, x) < 1e-6


def test_the_block_of_the_comparison() -> None:
    rest, tets = block(peers.CELLS)
    assert (len(rest), len(tets)) == (6875, 25920)
    volumes = np.linalg.det(rest[tets[:, 1:]] - rest[tets[:, :1]]) / 6.0
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(np.prod(rest.max(axis=0)))
    problem = active(peers.CELLS)
    xx, xy, xz, yy, yz, zz = problem.a.T
    A = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    assert np.linalg.det(A) == pytest.approx(1.0)
    contracted = np.abs(A - np.eye(3)).max(axis=(1, 2)) > 0.1
    assert 0.2 < contracted.mean() < 0.3


def answer_here(solver: str, python: Path, problem: Problem) -> Answer:
    """Solve in this process, whose kernels are compiled: a child's would take half a minute."""
    assert solver == "ours"
    x, iterations, status = Ours(asdict(problem)).solve()
    return Answer(x, np.ones(2), np.ones(2), iterations, status, 0.0)


def test_without_another_python_the_reason_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path))
    monkeypatch.setattr(environments, "_candidates", lambda: iter(["no-such-python"]))
    monkeypatch.setattr(peers, "QUICK_CELLS", CELLS)
    monkeypatch.setattr(peers, "answer", answer_here)
    options = argparse.Namespace(quick=True, python=None)
    figures = peers.run(options)
    assert figures["skipped"].startswith("no Python 3.12 or 3.13")
    assert figures["problems"]["active"]["ours"]["gradient_left"] < 1e-6
    figures = report.stamped(figures, ["peers.py"])
    text = documents.rendered(figures, peers.section(figures), tmp_path)
    assert "The peer was skipped: no Python 3.12 or 3.13" in text


def test_what_can_not_be_installed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path))
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho 'No space left on device' >&2; exit 1\n")
    os.chmod(fake, 0o755)
    with pytest.raises(UnavailableError, match=r"-m venv .*: No space left on device"):
        environment("peer", ["peer==1"], str(fake))
    assert not (tmp_path / "peers" / "peer" / "installed.txt").exists()
