"""What a head's lips and lids meet: its teeth and eyeballs, where jaw and edits put them."""

from dataclasses import replace

import numpy as np
import pytest

from solver.contact import Gauge, arches, contact_potentials, eyeballs
from solver.contact.crossing import crossing
from solver.contact.mouth import Mouth
from solver.contact.obstacles import Arch
from solver.edits import apply
from solver.edits.changes import Bone
from solver.mechanics.boundary import Boundary, move_jaw
from tests.solver.builtin_head import builtin_head

UPPER_LIP = "upper_lip", "upper_lip_lining"
LOWER_LIP = "lower_lip", "lower_lip_lining"
OPEN = np.array([0.1, 0.02, 0.3, -0.2, 0.1])


@pytest.fixture(scope="module")
def head():
    return builtin_head()


def at(b):
    return Boundary(np.empty((0, 3)), b)


def flesh(model, *regions):
    """Return the numbers of the flesh's vertices in regions of the skin."""
    ids = np.intersect1d(np.concatenate([model.regions[name] for name in regions]), model.embedded)
    return np.searchsorted(model.embedded, ids)


@pytest.mark.parametrize("number", [0, 1])
def test_lips_are_led_out_in_front_of_teeth_wherever_the_jaw_is(head, number):
    teeth = arches(head, Mouth.of(head), 3000.0)[number]
    lip = flesh(head, *(UPPER_LIP, LOWER_LIP)[number])
    closed = at(np.zeros(5))
    teeth.place(closed)
    assert teeth.value(head.rest) == 0.0
    back = head.rest.copy()
    back[lip, 2] -= 4.0
    assert len(teeth.behind(back, closed.jaw, 0.2)) > 3
    assert teeth.gradient(back)[lip, 2].sum() < 0.0
    assert Gauge(head).at(back, closed.jaw).behind_teeth >= len(teeth.behind(back, closed.jaw, 0.2))
    pushed = teeth.value(back)
    # the lower teeth go with the jaw, the upper ones stay
    teeth.place(at(OPEN))
    beside = back if number == 0 else move_jaw(head.jaw, back, OPEN)
    assert teeth.value(beside) == pytest.approx(pushed)


def test_unedited_teeth_are_tabulated_once(head, monkeypatch):
    tabulated = []
    of = Arch.of
    monkeypatch.setattr(Arch, "of", lambda *given: tabulated.append(given) or of(*given))
    potentials = contact_potentials(head, 3000.0, lips=False)
    assert len(tabulated) == 2
    again = Gauge(head, None, potentials)
    closed = np.zeros(5)
    assert len(tabulated) == 2
    assert again.at(head.rest, closed) == Gauge(head).at(head.rest, closed)


@pytest.mark.parametrize("number", [0, 1])
def test_lips_are_pushed_out_by_teeth_that_an_edit_moves_forward(head, number):
    label, bone = (("upper_teeth", "cranium"), ("lower_teeth", "mandible"))[number]
    # the lips lie on the teeth, some a little in them
    skin = head.skin.vertices.copy()
    skin[head.regions[label], 2] += 4.0
    near = replace(head, skin=head.skin.with_vertices(skin))
    front = skin[head.regions[label]]
    front = front[np.argmax(front[:, 2])]
    edit = Bone(bone, front, 30.0, np.array([0.0, 0.0, 5.0]))
    model = apply([edit], near, near.weights).model
    gauge = Gauge(model, near)
    closed = np.zeros(5)
    before = Gauge(near).at(near.rest, closed)
    assert before.behind_teeth == 0
    assert gauge.at(near.rest, closed).behind_teeth > 20
    potentials = contact_potentials(model, 3000.0, unedited=near, lips=False, eyes=False)
    x = near.rest.copy()
    for potential in potentials:
        potential.place(at(closed))
    for _ in range(30):
        for potential in potentials:
            # on a head without tets each vertex is on its own
            stiffness = potential.hessian(x).diagonal().reshape(-1, 3).sum(axis=1, keepdims=True)
            x -= potential.gradient(x) / np.maximum(stiffness, 1e-9)
    found = gauge.at(x, closed)
    assert found.behind_teeth == 0
    assert found.teeth < before.teeth + 0.2
    lip = flesh(model, *(UPPER_LIP, LOWER_LIP)[number])
    assert (x - near.rest)[lip, 2].max() > 1.5


def test_lids_lie_on_their_eyeballs(head):
    for side, potential in zip(("left", "right"), eyeballs(head, 3000.0), strict=True):
        potential.place(at(np.zeros(5)))
        assert potential.value(head.rest) == 0.0
        lids = flesh(head, f"{side}_upper_lid", f"{side}_lower_lid")
        back = head.rest.copy()
        back[lids, 2] -= 2.0
        gradient = potential.gradient(back)
        assert gradient[lids, 2].sum() < 0.0
        others = np.setdiff1d(np.arange(len(head.rest)), lids)
        assert not gradient[others].any()


def test_heads_without_teeth_or_eyes_meet_none(head):
    bare = replace(head, regions={name: head.regions[name] for name in ("upper_lip", "lower_lip")})
    assert arches(bare, Mouth.of(bare), 3000.0) == []
    assert eyeballs(bare, 3000.0) == []
    found = Gauge(bare).at(bare.rest, np.zeros(5))
    assert (found.teeth, found.objects, found.behind_teeth) == (0.0, 0.0, 0)


def test_depths_are_in_the_teeth_of_an_edited_jaw(head):
    """The chin, moved, is no measure of where the teeth are."""
    chin = head.rest[head.mandible]
    chin = chin[np.argmax(chin[:, 2] - chin[:, 1])]
    edited = apply([Bone("mandible", chin, 25.0, np.array([0.0, 0.0, 5.0]))], head, head.weights)
    model = edited.model
    x = model.rest + edited.bones
    lip = flesh(model, *LOWER_LIP)
    x[lip, 2] -= 4.0
    for moving in (lip, model.mandible):
        x[moving] = move_jaw(model.jaw, x[moving], OPEN)
    skin = model.skin.vertices.copy()
    skin[model.embedded] = x[: len(model.embedded)]
    teeth = model.attached_mandible
    skin[teeth] = move_jaw(model.jaw, skin[teeth], OPEN)
    found = crossing(Mouth.of(model), skin)
    assert found.lower_teeth > 0.5
    expected = max(found.upper_teeth, found.lower_teeth)
    assert Gauge(model).at(x, OPEN).teeth == pytest.approx(expected, abs=1e-6)
