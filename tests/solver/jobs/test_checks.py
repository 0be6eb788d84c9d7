"""The job that checks a scan: its files, and that a bad scan is a verdict and no exception."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.ingest import dense
from solver.errors import InputError
from solver.jobs import run_job
from solver.meshio.obj import write_obj
from solver.templates.builtin.build import builtin_expression

pytestmark = pytest.mark.long


def test_a_neutral_with_an_open_mouth_is_bad_as_an_expression_it_is_good(tmp_path: Path) -> None:
    scan = tmp_path / "scan.obj"
    write_obj(scan, dense(builtin_expression({"jawOpen": 0.5}), 2))
    verdicts = {}
    for role in ("neutral", "expression", "unknown"):
        report, picture = run_job("check_scan", tmp_path / role, scan=scan, role=role)
        found = json.loads(report.read_text(encoding="utf-8"))
        verdicts[role] = (found["verdict"], [entry["code"] for entry in found["findings"]])
        assert Image.open(picture).width > 1000
    assert verdicts == {
        "neutral": ("bad", ["scan.mouth_open"]),
        "expression": ("good", []),
        "unknown": ("good", ["scan.mouth_open"]),
    }


@pytest.mark.parametrize("content", [b"", b"v 1 2", b"\x00\x01" * 500])
def test_an_unreadable_scan_is_a_verdict_with_advice(content: bytes, tmp_path: Path) -> None:
    scan = tmp_path / "scan.obj"
    scan.write_bytes(content)
    report, picture = run_job("check_scan", tmp_path / "out", scan=scan)
    found = json.loads(report.read_text(encoding="utf-8"))
    assert found["verdict"] == "bad"
    (finding,) = found["findings"]
    assert finding["severity"] == "error"
    assert "scan.obj" in finding["message"]
    assert finding["advice"]
    assert picture.exists()


@pytest.mark.parametrize(
    ("size", "code"),
    [(1e-300, "scan.unit_unknown"), (1e90, "scan.unit_unknown"), (1e307, "scan.empty")],
)
def test_a_size_beyond_all_units_is_a_verdict(size: float, code: str, tmp_path: Path) -> None:
    scan = tmp_path / "scan.xyz"
    np.savetxt(scan, size * np.random.default_rng(0).standard_normal((300, 3)))
    report, _ = run_job("check_scan", tmp_path / "out", scan=scan)
    found = json.loads(report.read_text(encoding="utf-8"))
    assert found["verdict"] == "bad"
    assert code in [entry["code"] for entry in found["findings"]]


@pytest.mark.parametrize("options", [{"unit": "mile"}, {"up": "w"}, {"x": 1}])
def test_options_that_do_not_exist_are_refused(options: dict, tmp_path: Path) -> None:
    scan = tmp_path / "scan.obj"
    write_obj(scan, builtin_expression({}))
    with pytest.raises(InputError) as caught:
        run_job("check_scan", tmp_path / "out", scan=scan, options=options)
    assert caught.value.code.startswith("options.")


def test_a_role_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        run_job("check_scan", tmp_path / "out", scan=tmp_path / "scan.obj", role="boss")
    assert caught.value.code == "options.role"
