"""Prime movers: ranked on their side of the face, and what contradicts the literature is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.action_units import actions_of
from solver.rig.certificate import Muscles, contractions
from solver.rig.prime_movers import Movers, movers, ranked
from tests.solver.block import block_model


def test_muscles_are_ranked_by_how_much_they_shorten() -> None:
    fibres = np.array([0.9, np.nan, 0.5, 1.2, 0.1])
    judged = np.array([True, True, True, True, False])
    found = ranked(["a", "b", "c", "d", "e"], fibres, judged)
    assert list(found) == ["c", "a", "d"]
    assert found["d"] == pytest.approx(-0.2)


def judged(expression: str, **contractions: float) -> Movers:
    by_name = {name.replace("__", " "): by for name, by in contractions.items()}
    most = sorted(by_name.items(), key=lambda item: -item[1])
    return movers(dict(most), actions_of(expression))


def test_the_other_side_does_not_compete() -> None:
    found = judged(
        "mouthSmile_L",
        zygomaticus_major_l=0.1,
        risorius_r=0.5,
        buccinator_r=0.4,
        mentalis_r=0.3,
        procerus=0.2,
    )
    [check] = found.actions
    assert (check.rank, check.ahead, check.is_prime) == (2, ("procerus",), True)
    assert found.contradictions() == []


def test_muscles_of_another_unit_of_the_expression_do_not_compete() -> None:
    both = {"left__zygomaticus__major": 0.1, "orbital__part__of__left__orbicularis__oculi": 0.2}
    ranks = {check.action.unit.code: check.rank for check in judged("smile", **both).actions[::2]}
    assert ranks == {"AU 6": 1, "AU 12": 1}


def test_four_others_before_it_make_no_prime_mover() -> None:
    others = {"risorius_l": 0.5, "buccinator_l": 0.4, "mentalis_l": 0.3}
    [check] = judged("mouthSmileLeft", zygomaticus_major_l=0.2, **others).actions
    assert (check.rank, check.is_prime, check.is_judged) == (4, False, True)


def test_what_contradicts_is_told() -> None:
    found = judged("mouthSmileLeft", zygomaticus_major_l=-0.12, depressor_anguli_oris_l=0.3)
    [check] = found.actions
    assert check.rank is None
    assert found.contradictions() == [
        "zygomaticus_major_l lengthens by 12 %, which makes AU 12",
        "depressor_anguli_oris_l contracts by 30 %, against AU 12",
    ]
    # less than the prime mover, an antagonist steadies
    found = judged("mouthSmileLeft", zygomaticus_major_l=0.4, depressor_anguli_oris_l=0.3)
    assert found.contradictions() == []
    # and one that another unit of the expression calls for works for that
    found = judged("AU1+4", frontalis_l=0.1, corrugator_l=0.3, procerus=0.3)
    assert found.contradictions() == []


def test_a_unit_without_its_muscle_is_not_judged_but_its_antagonist_is() -> None:
    found = judged("jawOpen", masseter_deep_l=0.2, temporalis_r=-0.1)
    left, right = found.actions
    assert not left.is_judged
    assert left.missing == ("digastric", "lateral pterygoid")
    assert found.contradictions() == ["masseter_deep_l contracts by 20 %, against AU 26"]
    assert right.opposed == ()


def test_a_whole_muscle_contracts_as_its_compartments_do_on_average() -> None:
    model = replace(
        block_model(),
        muscle_names=("frontalis_l.medial", "frontalis_l.lateral"),
        wholes=("frontalis_l", "frontalis_l"),
    )
    stretches, one = np.array([0.6, 0.9]), np.ones(2)
    found = Muscles(one, one, one, stretches, flesh_mm3=np.array([100.0, 300.0]))
    assert contractions(model, found) == {"frontalis_l": pytest.approx(0.175)}
    unknown = replace(found, fibres=np.array([np.nan, 0.9]))
    assert contractions(model, unknown) == {"frontalis_l": pytest.approx(0.1)}
    assert contractions(model, replace(found, flesh_mm3=np.array([1.0, 2.0]))) == {}
