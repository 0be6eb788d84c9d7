"""Reading necks of OpenSim: our own file back, a real one beside OpenSim, and hostile ones."""

import re
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.neck import length_vs_opensim
from solver.errors import InputError
from solver.neck.body import Body
from solver.neck.builtin import builtin_neck
from solver.neck.elements import XmlLimits
from solver.neck.motion import MotionOptions, follow, reachable
from solver.neck.osim import OsimOptions, read_osim
from solver.neck.osim_joints import OsimJoint
from tests.fixtures import data_folder
from tests.osim_file import mutated, osim_text

TEXT = osim_text(builtin_neck())


def read(folder: Path, text: str, **options):
    file = folder / "neck.osim"
    file.write_text(text)
    return read_osim(file, OsimOptions(**options))


def test_a_neck_comes_back_as_it_was_written(tmp_path):
    neck = builtin_neck()
    back = read(tmp_path, TEXT)
    for name in ("centres", "masses", "mass_centres", "inertias", "stiffness", "damping"):
        np.testing.assert_allclose(getattr(back, name), getattr(neck, name), atol=1e-9)
    np.testing.assert_allclose(back.ranges, neck.ranges, atol=1e-12)
    np.testing.assert_allclose(back.shares, neck.shares, atol=1e-12)
    assert not back.notices
    for ours, read_ in zip(neck.muscles, back.muscles, strict=True):
        assert read_.name == ours.name
        np.testing.assert_array_equal(read_.bodies, ours.bodies)
        np.testing.assert_allclose(read_.points, ours.points, atol=1e-9)
        numbers = (read_.strength, read_.fibre, read_.tendon, read_.pennation)
        assert numbers == pytest.approx((ours.strength, ours.fibre, ours.tendon, ours.pennation))


@pytest.mark.long
def test_lengths_are_those_of_opensim():
    pytest.importorskip("opensim", reason="OpenSim is the oracle: pip install opensim")
    file = data_folder("neck", "mortensen_kinpassenger", "Mortensen2014_rigidTorso.osim")
    neck = read_osim(file)
    assert len(neck.muscles) == 72
    assert length_vs_opensim(file, Body(neck)) < 1e-6
    moved = Body(neck)
    moved.set_pose(np.full((8, 3), 0.1))
    rest = Body(neck).lengths
    assert np.abs(moved.lengths - rest).max() > 1e-3  # the poses do change lengths


def test_unphysical_inertias_are_replaced_and_told_or_kept():
    file = data_folder("neck", "mortensen_kinpassenger", "Mortensen2014_rigidTorso.osim")
    neck = read_osim(file)
    assert "replaced" in neck.notices[0]
    kept = read_osim(file, OsimOptions(keep_inertias=True))
    assert np.trace(kept.inertias[0]) > 50.0 * np.trace(neck.inertias[0])
    np.testing.assert_array_equal(kept.inertias[-1], neck.inertias[-1])


def test_an_axis_without_a_coordinate_does_not_turn(tmp_path):
    neck = builtin_neck()
    tilts = re.compile(r"<coordinates>\w+_2</coordinates>")
    fixed = read(tmp_path, tilts.sub("<coordinates></coordinates>", TEXT, count=1))
    assert not fixed.notices
    np.testing.assert_allclose(fixed.ranges[1:], neck.ranges[1:], atol=1e-12)
    np.testing.assert_allclose(fixed.ranges[0], neck.ranges[0] * (1.0, 1.0, 0.0), atol=1e-12)
    straight = read(tmp_path, tilts.sub("<coordinates></coordinates>", TEXT))
    goal = reachable(straight, np.array([0.0, 0.1]), np.zeros((2, 3)))
    assert np.isfinite(follow(straight, goal, MotionOptions(settle_s=0.1)).turns).all()


def test_a_long_chain_of_bodies_is_walked_once(tmp_path, monkeypatch):
    names = ["head", *(f"plume{number}" for number in range(100))]
    bodies = "".join(
        f'<Body name="{name}"><mass>0.001</mass><inertia>1 1 1 0 0 0</inertia></Body>'
        for name in names[1:]
    )
    joints = "".join(
        f'<WeldJoint name="to_{on}"><socket_parent_frame>/bodyset/{under}</socket_parent_frame>'
        f"<socket_child_frame>/bodyset/{on}</socket_child_frame></WeldJoint>"
        for under, on in pairwise(names)
    )
    text = TEXT.replace("</objects></BodySet>", f"{bodies}</objects></BodySet>")
    text = text.replace("</objects></JointSet>", f"{joints}</objects></JointSet>")
    walked = []
    placed = OsimJoint.placed.fget

    def count(joint):
        walked.append(joint.child)
        return placed(joint)

    monkeypatch.setattr(OsimJoint, "placed", property(count))
    neck = read(tmp_path, text)
    assert neck.masses[-1] == pytest.approx(builtin_neck().masses[-1] + 0.1)
    assert len(walked) == len(set(walked)) == 109


WRAP = '<WrapObjectSet><objects><WrapSphere name="ball"/></objects></WrapObjectSet></Model>'
USED = '<PathWrapSet><objects><PathWrap name="round"/></objects></PathWrapSet></GeometryPath>'
BAD = {
    "wrap object": (r"</Model>", WRAP, "ball"),
    "used wrap": (r"</GeometryPath>", USED, "round"),
    "moving point": (
        r"<PathPoint (.*?)</PathPoint>",
        r"<MovingPathPoint \1</MovingPathPoint>",
        "p0",
    ),
    "slider": (r"<CustomJoint (.*?)</CustomJoint>", r"<SliderJoint \1</SliderJoint>", "to_C7"),
    "missing body": (r"<Body name=\"C4\">.*?</Body>", "", "socket_parent"),
    "another root": (r"OpenSimDocument", "Document", "Document"),
    "no bodies": (r"<BodySet.*</BodySet>", "", "neck"),
    "no head": (r"([\"/])head([\"<])", r"\1skul\2", "bodyset"),
    "NaN": (r"<location>[^<]*", "<location>nan 0 0", "location"),
    "infinite": (r"<location>[^<]*", "<location>1e400 0 0", "location"),
    "two numbers": (r"<location>[^<]*", "<location>0 0", "location"),
    "a word": (r"<mass>[^<]*", "<mass>heavy", "mass"),
    "negative": (r"<max_isometric_force>[^<]*", "<max_isometric_force>-5", "max_isometric_force"),
    "far": (r"<location>[^<]*", "<location>1e5 0 0", "p0"),
    "shift": (r"<value>0", "<value>0.01", "translation1"),
    "circle": (r"/ground<", "/bodyset/head<", ""),
    "inches": (r"meters", "inches", "length_units"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_not_read_is_told_with_its_line_and_element(name, tmp_path):
    pattern, put, element = BAD[name]
    text = re.sub(
        pattern, put, TEXT, count=0 if name in ("no head", "another root") else 1, flags=re.DOTALL
    )
    assert text != TEXT
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    error = caught.value
    assert error.code == "neck.osim"
    assert error.context["file"] == "neck.osim"
    assert 1 <= error.context["line"] <= text.count("\n") + 1
    assert error.context["element"] == (element or error.context["element"])


def test_entities_are_neither_expanded_nor_fetched(tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("12345")
    bomb = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12))
    for declared in (f'<!ENTITY x SYSTEM "file://{secret}">', f'<!ENTITY a0 "ha">{bomb}'):
        text = TEXT.replace("<OpenSimDocument", f"<!DOCTYPE o [{declared}]><OpenSimDocument", 1)
        text = text.replace("<mass>30.0", "<mass>&x;" if "SYSTEM" in declared else "<mass>&a11;", 1)
        with pytest.raises(InputError, match="document type") as caught:
            read(tmp_path, text)
        assert "12345" not in str(caught.value.as_dict())


def test_large_and_deep_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="MB"):
        read(tmp_path, TEXT, limits=XmlLimits(bytes=1000))
    with pytest.raises(InputError, match="more than"):
        read(tmp_path, TEXT, limits=XmlLimits(elements=100))
    with pytest.raises(InputError, match="deep"):
        read(tmp_path, "<a>" * 5000 + "</a>" * 5000)
    with pytest.raises(InputError, match="no XML"):
        read(tmp_path, TEXT[:5000])


@pytest.mark.long
@pytest.mark.parametrize("seed", range(25))
def test_mutated_files_are_refused_or_make_a_neck_that_stays_finite(seed, tmp_path):
    for number in range(4):
        neck = read_or_refuse(tmp_path, mutated(TEXT, 4 * seed + number))
        if neck is not None:
            goal = reachable(neck, np.array([0.0, 0.1]), np.zeros((2, 3)))
            motion = follow(neck, goal, MotionOptions(settle_s=0.1))
            assert np.isfinite(motion.turns).all()


def read_or_refuse(folder: Path, text: str):
    """Return the neck; None where the file is refused as a neck. Nothing else may be raised."""
    with suppress(InputError):
        return read(folder, text)
    return None
