"""Takes that live sessions record are solved exactly, and it is told how far live was off."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.animation.blendshapes import Blendshapes, Solved
from solver.errors import InputError
from solver.fitting.face import Pose
from solver.fitting.markers.term import MarkerPlaces
from solver.jobs import run_job
from solver.kinds.live_messages import FollowedFrame
from solver.live.sent import FILE
from solver.live.session import arrays_of
from solver.live.skin import LiveSkin
from solver.rig import Rig
from solver.scans.live_link import ARKIT_NAMES
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.similarity import IDENTITY, small_motion
from solver.storage import Archive
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template
from tests.solver.live.live_client import OPEN, Client
from tests.solver.live.live_rig import live_files

pytestmark = pytest.mark.long

NAME = "smile"
CLOSE_MM = 0.01  # a sequence's jaw is the free one that is nearest to what was fitted
MARKERS = 30
Files = dict[str, Path]


class Recorded:
    """A session of a ``source`` that was recorded, and the faces that it sent."""

    def __init__(self, files: Files, out: Path, source: str, frames: list[Floats]) -> None:
        self.rig = Rig.load(files)
        self.frames: list[FollowedFrame] = []
        client = Client(files, out, source=source)
        ready = client.hear("ready")
        self._layout = tuple((each["name"], tuple(each["shape"])) for each in ready["layout"])
        client.say(record=NAME)
        for number, numbers in enumerate(frames):
            client.frame(number, 5.0 + number / 60, numbers.astype("<f4"))
            self.frames.append(client.followed())
        client.say(stop=True)
        self.take = out / client.hear("take")["file"]
        client.say(end=True)
        client.hear("ended")
        client.thread.join()
        self.sent = out / FILE
        assert self.sent in client.left
        assert not list(out.glob("*.part"))
        shapes = builtin_template().shapes.expressions
        self._skin = LiveSkin.load(out / "live_skin.npz", self.rig.face(), shapes)

    def off(self, number: int, exact: Floats) -> float:
        """Return how far the face that was sent of a frame is off an exact one (k, 3)."""
        amounts = arrays_of(self.frames[number], self._layout)["amounts"]
        skin = self.rig.model.skin.vertices + np.tensordot(amounts, self._skin.basis, 1)
        return float(np.linalg.norm(skin[self.rig.model.face] - exact, axis=1).mean())

    def fitted(self, out: Path) -> dict[int, Floats]:
        """Return the faces (k, 3) of a fit's frames by their numbers."""
        face = self.rig.face()
        state = face.rest
        found = {}
        with np.load(out / "sequence.npz") as fitted:
            poses = zip(fitted["frame"], fitted["activations"], fitted["jaw"], strict=True)
            for place, (number, a, jaw) in enumerate(poses):
                state = face.continuation(state, face.pose_of(a, jaw))
                if fitted["status"][place] == "fitted":
                    skin = face.whole_skin(state.x, state.pose.b)
                    found[int(number)] = skin[self.rig.model.face]
        return found


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    return live_files(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def weights(files: Files, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The jaw opens; the third frame says nothing, and is held."""
    frames = [OPEN.copy() for _ in range(4)]
    for number, row in enumerate(frames):
        row[ARKIT_NAMES.index("jawOpen")] = 0.2 * number
    frames.insert(2, np.full(61, np.nan))
    return Recorded(files, tmp_path_factory.mktemp("weights"), "weights", frames)


def animate(recorded: Recorded, files: Files, out: Path, sent: Path, **scene: Any) -> Any:
    """Play a take by a jaw that opens as the session's does, the skin not."""
    rig = recorded.rig
    jaw = np.array([0.25, 0.0, 0.0, 0.0, 0.0])
    shapes = {"jawOpen": Solved(Pose(rig.face().rest_pose().a, jaw), 0.1)}
    kept = out.with_name("shapes.npz")
    Blendshapes(rig.model.muscle_names, shapes).save(kept, rig.model, rig.weights)
    options = {"scene": {"recording": {"asset": "take", **scene}}}
    beside = {"blendshapes": kept, "live_takes": sent, "rig": files["rig"]}
    run_job("animate", out, options=options, captures={"take": recorded.take}, **beside)
    return json.loads((out / "animation.json").read_text())["live"]


def check(told: dict[str, Any], expected: dict[int, float]) -> None:
    off = [*expected.values()]
    assert (told["take"], told["frames"]) == (NAME, len(expected))
    figures = (np.mean(off), np.median(off), np.percentile(off, 95), max(off))
    names = ("mean_mm", "p50_mm", "p95_mm", "max_mm")
    assert [told[name] for name in names] == pytest.approx(figures, abs=CLOSE_MM)
    assert expected[told["max_frame"]] == max(off)
    assert max(off) > 10 * CLOSE_MM
    assert told["told"] == {"p50_mm": None, "p95_mm": None}  # nothing was solved beside it


def test_weights_are_off_what_is_played(weights: Recorded, files: Files, tmp_path: Path) -> None:
    """The recording has no frame of what was not seen: its third is the session's fourth."""
    told = animate(weights, files, tmp_path / "out", weights.sent, start=1)
    with np.load(tmp_path / "out/animation.npz") as played:
        assert played["vertices"].tolist() == weights.rig.model.face.tolist()
        exact = [
            small_motion(head).inverse()(skin)
            for head, skin in zip(played["head"], played["skin"], strict=True)
        ]
    sent = (1, 3, 4)
    check(told, {n: weights.off(sent[n], skin) for n, skin in enumerate(exact)})


def test_points_are_off_their_fit(files: Files, tmp_path: Path) -> None:
    """The job takes every second frame, by another rate."""
    rig = Rig.load(files)
    face = rig.face()
    opened = [face.pose_of(face.rest_pose().a, np.array([0.02 * n, 0, 0, 0, 0])) for n in range(5)]
    state = face.rest
    skins = []
    for pose in opened:
        state = face.continuation(state, pose)
        skins.append(face.whole_skin(state.x, pose.b))
    recorded = Recorded(files, tmp_path / "live", "points", skins)
    options = {"step": 2, "fps": 25.0, "head_motion": True, "max_iterations": 3}
    given = {"performance": recorded.take, "live_takes": recorded.sent, "rig": files["rig"]}
    run_job("fit_sequence", tmp_path / "out", options=options, **given)
    told = json.loads((tmp_path / "out/sequence.json").read_text())["live"]
    exact = recorded.fitted(tmp_path / "out")
    check(told, {number: recorded.off(number, skin) for number, skin in exact.items()})
    assert told["frames"] == 3


@pytest.mark.parametrize("smooth", [False, True])
def test_markers_are_off_their_fit(files: Files, tmp_path: Path, smooth: bool) -> None:
    """A take counts its frames from 1."""
    rig = Rig.load(files)
    model = rig.model
    face = rig.face()
    rng = np.random.default_rng(7)
    inside = model.skin.faces[np.isin(model.skin.faces, model.face).all(axis=1)]
    corners = inside[rng.choice(len(inside), MARKERS, replace=False)]
    markers = tuple(
        Marker(f"M{n}", tuple(map(int, each)), sigma_mm=0.3) for n, each in enumerate(corners)
    )
    MarkerSet(markers, IDENTITY, model.sha256).save(tmp_path / "set.json")
    state = face.rest
    points = []
    for number in range(5):
        pose = face.pose_of(face.rest_pose().a, np.array([0.03 * number, 0, 0, 0, 0]))
        state = face.continuation(state, pose)
        points.append(MarkerPlaces(model, markers).at(state.x))
    points[3][:] = np.nan
    given = {**files, "marker_set": tmp_path / "set.json"}
    recorded = Recorded(given, tmp_path / "live", "markers", points)
    given |= {"markers": recorded.take, "live_takes": recorded.sent}
    options = {"prior": "scans", "refine": 0, "smooth": smooth}
    run_job("fit_markers", tmp_path / "out", options=options, **given)
    told = json.loads((tmp_path / "out/sequence.json").read_text())["live"]
    exact = recorded.fitted(tmp_path / "out")
    check(told, {number: recorded.off(number - 1, skin) for number, skin in exact.items()})
    assert told["frames"] == 4


def test_files_that_are_not_the_takes_are_refused(
    weights: Recorded, files: Files, tmp_path: Path
) -> None:
    archive = Archive.read(weights.sent, "live_takes", "takes", 1)
    other = tmp_path / FILE

    def refused(header: dict[str, Any], **arrays: np.ndarray) -> str:
        Archive({**archive.header, **header}, {**archive.arrays, **arrays}).write(other)
        with pytest.raises(InputError) as caught:
            animate(weights, files, tmp_path / "out", other)
        return caught.value.code

    [take] = archive.header["takes"]
    assert refused({"format": 2}) == "live_takes.format"
    assert refused({"of": {**archive.header["of"], "weights": "another"}}) == "live_takes.rig"
    assert refused({"takes": [{**take, "sha256": "another"}]}) == "live_takes.take"
    assert refused({}, frames_0=np.zeros(1, np.int64)) == "live_takes.unreadable"
    assert refused({}, amounts_0=np.full((4, 52), np.nan, np.float16)) == "live_takes.unreadable"
    assert refused({}, amounts_0=np.zeros((4, 52))) == "live_takes.unreadable"
    assert refused({}, basis=np.zeros((1, 2, 3), np.float16)) == "live_takes.unreadable"
    told = {"told": {"p50_mm": 10**400, "p95_mm": None}}
    assert refused({"takes": [{**take, **told}]}) == "live_takes.unreadable"
    other.write_bytes(weights.sent.read_bytes()[:1000])
    with pytest.raises(InputError) as caught:
        animate(weights, files, tmp_path / "out", other)
    assert caught.value.code == "live_takes.unreadable"
    assert not (tmp_path / "out/frames").exists()
