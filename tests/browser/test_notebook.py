"""`Rig.show()` draws in a browser: expressions by sliders, turned by hand and by keys."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image

from solver.model import SubjectModel
from solver.rig import ExpressionFit, Rig
from solver.templates.builtin.build import builtin_expression
from tests.solver.block import block_model


def _rig() -> Rig:
    from dataclasses import replace

    skin = builtin_expression({})
    model: SubjectModel = replace(block_model(), skin=skin, face=np.arange(1000))
    error = np.full(len(skin.vertices), np.nan)
    error[model.face] = 1.5
    fits = []
    told = {}
    for name, weights in (("ah <b>", {"jawOpen": 1.0}), ("smile", {"mouthSmileLeft": 1.0})):
        shape = builtin_expression(weights).vertices
        rest = np.zeros((model.muscle_count, 6))
        fits.append(
            ExpressionFit(name, "train", rest, rest[0, :5], shape, shape, error, 0, 1, 1.0, 0.1)
        )
        muscles = {each: {"fibres": 1.0} for each in model.muscle_names}
        told[name] = {"mean_mm": 0.4, "p95_mm": 1.0, "max_mm": 2.0, "muscles": muscles}
    return Rig(model, model.weights, tuple(fits), figures={"expressions": told})


def test_a_cell_shows_the_rig(context: Any) -> None:
    faults: list[str] = []
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on(
        "console", lambda message: faults.append(message.text) if message.type == "error" else None
    )
    page.on("request", lambda request: faults.append(request.url))
    page.set_content(_rig().show(height=500)._repr_html_())
    frame = page.frame_locator("iframe")
    canvas = frame.locator("canvas")

    def picture() -> Any:
        page.wait_for_timeout(800)
        return np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB"), float)

    neutral = picture()
    assert neutral.std() > 10
    frame.get_by_label("ah <b>").fill("1")
    opened = picture()
    assert np.abs(opened - neutral).mean() > 0.5
    frame.get_by_label("Distance to the scans").check()
    assert np.abs(picture() - opened).mean() > 1
    frame.get_by_label("Distance to the scans").uncheck()
    frame.get_by_role("button", name="Neutral").click()
    np.testing.assert_allclose(picture(), neutral, atol=3)
    canvas.focus()
    for _ in range(8):
        page.keyboard.press("ArrowRight")
    assert np.abs(picture() - neutral).mean() > 1
    assert faults == []
