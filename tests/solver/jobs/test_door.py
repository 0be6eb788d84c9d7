"""The door of all jobs: what a kind of job itself has no word for."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from solver import jobs
from solver.errors import InputError, SolveError


def test_a_matrix_without_an_inverse_is_told_and_no_crash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(_: object) -> None:
        np.linalg.inv(np.zeros((2, 2)))

    monkeypatch.setattr(jobs, "import_module", lambda _: SimpleNamespace(run=run))
    with pytest.raises(SolveError, match=r"fit markers: .*Singular") as caught:
        jobs.run_job("fit_markers", tmp_path)
    assert caught.value.code == "solve.singular"


def test_kinds_and_files_that_are_not_there_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no kind of job 'fit_activation': there are animate,"):
        jobs.run_job("fit_activation", tmp_path)
    with pytest.raises(InputError, match="needs the file rig, and was given gir") as caught:
        jobs.run_job("fit_fibres", str(tmp_path), gir="rig.npz")
    assert caught.value.code == "job.missing"
