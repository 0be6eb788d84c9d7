"""Prime movers: ranked on their side of the face, and what contradicts the literature is told."""

from __future__ import annotations

import numpy as np
import pytest

from solver.anatomy.action_units import actions_of
from solver.fitting.contraction import STILL
from solver.fitting.drives.admissible import ADMISSIBLE
from solver.rig.report.prime_movers import Movers, movers, rank_contractions


def test_muscles_are_ranked_by_how_much_they_shorten() -> None:
    contraction = np.array([0.1, np.nan, 0.5, -0.2, 0.9])
    judged = np.array([True, True, True, True, False])
    found = rank_contractions(["a", "b", "c", "d", "e"], contraction, judged)
    assert list(found) == ["c", "a", "d"]
    assert found["d"] == pytest.approx(-0.2)


def judged(expression: str, **contractions: float) -> Movers:
    """Return who moves: ``_l__part`` is a compartment of ``_l``, another ``__`` a space."""
    by_name = {
        name.replace("_l__", "_l.").replace("_r__", "_r.").replace("__", " "): by
        for name, by in contractions.items()
    }
    most = dict(sorted(by_name.items(), key=lambda item: -item[1]))
    return movers(most, {name: name.split(".")[0] for name in most}, actions_of(expression))


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
    assert [str(each) for each in found.contradictions()] == [
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
    assert left.missing == ("digastric", "geniohyoid", "lateral pterygoid")
    [said] = found.contradictions()
    assert str(said) == "masseter_deep_l contracts by 20 %, against AU 26"
    assert right.opposed == ()


def test_a_whole_muscle_counts_by_the_compartment_that_contracts_most() -> None:
    found = judged(
        "mouthSmile_L",
        zygomaticus_major_l__superior=0.43,
        zygomaticus_major_l__inferior=-0.09,
        levator_labii_superioris_l__medial=0.5,
        levator_labii_superioris_l__lateral=0.48,
        risorius_l=0.45,
    )
    [check] = found.actions
    assert next(iter(found.contractions)) == "levator_labii_superioris_l.medial"
    assert check.muscles == ("zygomaticus_major_l.superior",)
    # two parts of one muscle take one place
    assert (check.rank, check.ahead) == (3, ("levator_labii_superioris_l.medial", "risorius_l"))
    assert check.lengthened == check.idle == ()


def test_a_muscle_of_the_expression_that_holds_still_is_told() -> None:
    found = judged("grin", zygomaticus_major_l=0.004, zygomaticus_major_r=0.3)
    assert [str(each) for each in found.idle()] == [
        "zygomaticus_major_l does not contract (0 %), which makes AU 12, lip corner puller"
    ]
    # lips part (AU 25) by relaxing, too: depressor labii may rest
    assert judged("AU25", depressor_labii_inferioris_l=0.0).idle() == []
    # one muscle of a unit makes it
    assert judged("AU20", risorius_l=0.1, platysma_l=0.0).idle() == []


def test_a_muscle_at_the_bound_of_its_fibres_holds_still() -> None:
    bound = 1.0 - ADMISSIBLE.fibre
    found = judged("grin", zygomaticus_major_l=bound, zygomaticus_major_r=0.3)
    assert found.contradictions() == []
    assert [each.muscle for each in found.idle()] == ["zygomaticus_major_l"]
    assert STILL.is_still(bound)


def test_left_is_told_against_right() -> None:
    uneven = judged(
        "kiss",
        orbicularis_oris_upper_l__medial=0.13,
        orbicularis_oris_upper_r__medial=0.37,
        mentalis_l=0.02,
        mentalis_r=-0.05,
        procerus=0.3,
    ).uneven()
    assert str(uneven[0]) == (
        "orbicularis_oris_upper_r.medial contracts by 37 %, orbicularis_oris_upper_l.medial by 13 %"
    )
    assert [round(each.amount, 3) for each in uneven] == [0.24, 0.02]


def test_of_a_muscle_whose_part_is_named_that_part_counts() -> None:
    lips = {f"orbicularis_oris_{lip}_{side}" for lip in ("upper", "lower") for side in "lr"}
    wrong = judged("mouthFunnel", **{f"{lip}__marginal": 0.3 for lip in lips})
    assert [check.rank for check in wrong.actions] == [None, None]
    both = {f"{lip}__{part}": by for lip in lips for part, by in OF_LIPS.items()}
    ranks = [check.rank for check in judged("mouthFunnel", **both).actions]
    assert ranks == [3, 3]  # behind the margins of both lips


OF_LIPS = {"peripheral": 0.2, "marginal": 0.3}
