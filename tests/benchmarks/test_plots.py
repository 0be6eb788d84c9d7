from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import plots
from benchmarks.plots import Curve, Tradeoff

PLOTS = ("convergence", "descent", "frames", "bars", "tradeoff")


def draw_all(folder: Path) -> list[Path]:
    paths = [folder / f"{name}.png" for name in PLOTS]
    curves = {
        "A": Curve([4.0, 2.0, 1.0], [0.0, 0.1, 0.2]),
        # infeasible points of IPOPT lie below its end
        "IPOPT": Curve([4.0, 0.5, 2.0, 1.0], [0.0, 1.0, 2.0, 3.0]),
    }
    plots.convergence(paths[0], "Smile", curves)
    plots.descent(paths[1], "Rounds", "mm", {"smile": [2.0, 1.0], "kiss": [1.5, 0.5]})
    plots.frame_times(paths[2], "Frames", [20.0, 30.0, 500.0], 60.0)
    plots.bars(
        paths[3], "Errors", "mm", ["smile", "kiss"], {"S": [0.4, 0.3], "P": [0.2, 0.1]}, 0.45
    )
    line = Tradeoff([0.5, 0.3], {"stretch": [1.0, 2.0], "volume": [10.0, 70.0]})
    plots.tradeoff(paths[4], "Skin against muscles", "mm", ["1", "0"], {"Ada": line})
    return paths


def test_plots_are_pictures_and_the_same_twice(tmp_path: Path) -> None:
    for first, again in zip(draw_all(tmp_path / "1"), draw_all(tmp_path / "2"), strict=True):
        assert first.read_bytes() == again.read_bytes()
        pixels = np.asarray(Image.open(first).convert("L"))
        assert pixels.shape[1] > 900
        assert (pixels[0] == 255).all()
        assert (pixels < 200).mean() > 0.005


def test_scaling_names_the_exponent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plots.STYLE, "svg.fonttype", "none")
    vertices = [2000, 7000, 19000]
    seconds = {"simulation": [1e-6 * count**1.3 for count in vertices]}
    plots.scaling(tmp_path / "scaling.svg", "Cost", vertices, seconds)
    assert "simulation: exponent 1.30" in (tmp_path / "scaling.svg").read_text(encoding="utf-8")
