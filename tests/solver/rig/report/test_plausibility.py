"""Plausibility: figures of known contractions and jaw motions, and what is said of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.mechanics.boundary import FreeJaw
from solver.mechanics.flesh import shape_gradients
from solver.model import SubjectModel
from solver.rig.report.certificate import ExpressionMuscles, jaw_motion, muscles
from solver.surface import Floats
from tests.solver.block import block_model

ALONG = np.array([3.0, 4.0, 0.0]) / 5.0


def six(matrix: Floats) -> Floats:
    return matrix[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]


@pytest.fixture(scope="module")
def model() -> SubjectModel:
    """Return the block; all fibres of both muscles run along :data:`ALONG`."""
    block = block_model()
    fibres = np.where((block.weights.indices > 0)[:, None], ALONG, 0.0)
    return replace(block, fibres=fibres)


def found(model: SubjectModel, left: Floats, right: Floats) -> ExpressionMuscles:
    volumes = shape_gradients(model.rest, model.tets)[1]
    return muscles(model, volumes, model.weights, np.array([six(left), six(right)]))


def contraction(along: float, across: float) -> Floats:
    return across * np.eye(3) + (along - across) * np.outer(ALONG, ALONG)


def test_a_muscle_that_contracts_and_thickens_is_plausible(model: SubjectModel) -> None:
    seen = found(model, contraction(0.8, 0.8**-0.5), np.eye(3))
    assert seen.fibres == pytest.approx([0.8, 1.0])
    assert seen.volume == pytest.approx([1.0, 1.0])
    assert (seen.shortest[0], seen.longest[0]) == pytest.approx((0.8, 0.8**-0.5))
    assert seen.flesh_mm3[0] > 1000.0
    assert seen.faults(0) == seen.faults(1) == []
    assert len(seen.inside_out) == 0


def test_what_muscles_can_not_do_is_said(model: SubjectModel) -> None:
    seen = found(model, contraction(1.4, 0.9), contraction(-0.2, 2.5))
    assert seen.faults(0) == ["pushes: its fibres lengthen to 140 %"]
    assert seen.faults(1) == ["is turned inside out", "stretches to 250 % in one direction"]
    assert seen.inside_out.tolist() == [1]
    flat = found(model, contraction(0.3, 1.0), contraction(0.9, 1.6))
    assert flat.faults(0) == ["shrinks to 30 % in one direction", "has 30 % of its volume"]
    assert flat.faults(1) == ["has 230 % of its volume"]


def test_a_muscle_without_flesh_is_not_judged(model: SubjectModel) -> None:
    S = model.weights.copy()
    S.data[S.indices == 2] = 0.0
    volumes = shape_gradients(model.rest, model.tets)[1]
    a = np.array([six(np.eye(3)), six(-np.eye(3))])
    seen = muscles(model, volumes, S, a)
    assert seen.faults(1) == []
    assert np.isnan(seen.fibres[1])
    assert len(seen.inside_out) == 0
    assert np.isnan(muscles(replace(model, fibres=None), volumes, S, a).fibres).all()


def test_the_jaws_motion(model: SubjectModel) -> None:
    matrix = FreeJaw(model.jaw).matrix
    opened = jaw_motion(model, matrix(np.array([0.3, 0.0, 0.0, 0.0, 0.0])))
    assert opened.point == "chin"
    assert opened.opening_deg == pytest.approx(np.degrees(0.3))
    assert opened.opening_mm > 5.0  # the back of the block is 30 mm in front of the hinge
    assert opened.faults() == []
    left = jaw_motion(model, matrix(np.array([0.0, 0.1, 1.0, 0.0, 0.0])))
    assert left.sideways_mm > 1.0
    assert left.faults() == []
    torn = jaw_motion(model, matrix(np.array([0.0, 0.0, 0.0, -30.0, -6.0])))
    assert torn.condyles_down_mm == pytest.approx(30.0)
    assert torn.faults() == ["is 6.0 mm behind its sockets", "drops from its sockets by 30 mm"]
