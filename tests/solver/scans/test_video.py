"""Videos as recordings: whose face is followed, and what is no video."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.errors import InputError
from solver.kinds.inputs import FILMS
from solver.kinds.scene_recording import Recording
from solver.registration.detector import EYE_CORNERS, DetectedFace
from solver.rig.frames.animation import write_video
from solver.scans import video
from solver.scans.film import FilmLimits, FilmPicture, decode_film, is_film
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.scans.recordings import read_recording
from tests.fixtures import data_folder, face_landmarker

WIDTH = 640
HEIGHT = 360
Place = tuple[float, float, float]  # of a face: middle and size, px
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def face(place: Place) -> DetectedFace:
    """Return a face that says by its smile how large it is."""
    column, row, size = place
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (478, 2)) * size
    points[[0, 1]] = [[-0.5 * size, -0.5 * size], [0.5 * size, 0.5 * size]]
    points[list(EYE_CORNERS)] = [[-0.3 * size, 0.0], [0.3 * size, 0.0]]
    weights = {"mouthSmileLeft": size / 1000, "_neutral": 0.5}
    return DetectedFace(points + np.array([column, row]), np.eye(3), weights)


class Shown(FilmPicture):
    def pixels(self) -> Any:
        return np.full((HEIGHT, WIDTH, 3), self.decoded, np.uint8)


def follow(
    monkeypatch: pytest.MonkeyPatch, frames: list[list[Place]], who: int | None = None
) -> FaceTake:
    """Return what is measured of faces at places in frames."""

    class Detector:
        def faces_in(self, pixels: np.ndarray) -> list[DetectedFace]:
            return [face(place) for place in frames[int(pixels[0, 0, 0])]]

    @contextmanager
    def detector(_: object) -> Iterator[Detector]:
        yield Detector()

    shown = [Shown(number / 25.0, number) for number in range(len(frames))]
    monkeypatch.setattr(video, "_detector", detector)
    monkeypatch.setattr(video, "decode_film", lambda *_: iter(shown))
    return video.read_video(Path("take.mp4"), who)


def sizes(take: FaceTake) -> list[int]:
    smile = take.weights[:, ARKIT_NAMES.index("mouthSmileLeft")]
    return (1000 * smile).round().astype(int).tolist()


def test_the_largest_face_at_the_middle_is_taken_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    frames: list[list[Place]] = [[(320 + k, 180, 100), (600 - k, 300, 110)] for k in range(8)]
    take = follow(monkeypatch, frames)
    assert sizes(take) == [100] * 8
    assert [notice.code for notice in take.notices] == ["video.faces"]
    other = follow(monkeypatch, frames, 1)
    assert sizes(other) == [110] * 8
    assert not other.notices
    with pytest.raises(InputError) as error:
        follow(monkeypatch, frames, 2)
    assert error.value.code == "video.faces"


def test_two_faces_stay_apart_when_the_smaller_becomes_the_larger(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As when one of two comes nearer: both are in the same frames, in another order."""
    frames: list[list[Place]] = [[(250, 180, 90 + 4 * k), (400, 180, 100)] for k in range(8)]
    assert sizes(follow(monkeypatch, frames, 0)) == [90 + 4 * k for k in range(8)]
    assert sizes(follow(monkeypatch, frames, 1)) == [100] * 8


def test_a_moments_face_elsewhere_after_a_gap_is_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    here = (320.0, 180.0, 100.0)
    there = (100.0, 100.0, 50.0)
    one: list[list[Place]] = [[here]]
    frames = one * 6 + [[]] * 10 + [[there]] * 4 + [[]] * 3
    assert follow(monkeypatch, frames).seen.sum() == 6
    back = one * 6 + [[]] * 10 + one * 2  # where it was: it is the face again
    assert follow(monkeypatch, back).seen.sum() == 8
    cut = one * 6 + [[]] * 10 + [[there]] * 5  # it lasts
    assert sizes(follow(monkeypatch, cut))[-5:] == [50] * 5
    with pytest.raises(InputError) as error:
        follow(monkeypatch, [[]] * 9 + one * 2 + [[]] * 9)
    assert error.value.code == "video.no_face"


def test_a_face_that_is_filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MYOFACE_FACE_LANDMARKER", str(face_landmarker()))
    path = data_folder("videos", "face_noface.mov")
    entry = Recording(asset="take")
    kept = tmp_path / "signals.csv"
    take = read_recording(path, entry, kept)
    assert len(take.times) == 169
    assert (take.seen.sum(), len(take.gaps)) == (72, 1)  # the stray one at 6.15 s is not
    steps = np.diff(take.times)
    assert steps.min() < 0.02 < 0.04 < steps.max()
    assert take.weights[:, ARKIT_NAMES.index("mouthSmileLeft")].max() > 0.5
    assert not take.weights[:, ARKIT_NAMES.index("noseSneerLeft")].any()
    again = read_recording(kept, entry)
    np.testing.assert_allclose(again.weights, take.weights, atol=1e-8)
    np.testing.assert_allclose(again.times, take.times, atol=1e-9)
    with pytest.raises(InputError) as error:
        read_recording(data_folder("videos", "no_face.mp4"), entry)
    assert error.value.code == "video.no_face"


def test_the_model_of_the_detector_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = filmed(tmp_path / "film.mp4")
    monkeypatch.delenv("MYOFACE_FACE_LANDMARKER", raising=False)
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path))
    assert "myoface assets fetch landmarker" in refused(film, "video.model")
    renamed = film.rename(tmp_path / "film.csv")  # what it is its content says
    assert "myoface assets fetch landmarker" in refused(renamed, "video.model")
    film = renamed.rename(film)
    with pytest.raises(InputError) as error:
        read_recording(film, Recording(asset="take", au_scale=1.0))
    assert error.value.code == "video.options"
    face_landmarker()
    (tmp_path / "damaged.task").write_bytes(b"none")
    for name in ("damaged.task", "none.task"):
        monkeypatch.setenv("MYOFACE_FACE_LANDMARKER", str(tmp_path / name))
        assert "myoface assets fetch landmarker" in refused(film, "video.model")


def filmed(path: Path, frames: int = 6, size: tuple[int, int] = (64, 96)) -> Path:
    pytest.importorskip("av")
    write_video(path, [np.full((size[1], size[0], 3), 0.1 * k) for k in range(frames)], size, 25.0)
    return path


def refused(path: Path, code: str) -> str:
    with pytest.raises(InputError) as error:
        read_recording(path, Recording(asset="take"))
    assert error.value.code == code
    return error.value.message


def decoded(path: Path, **limits: Any) -> list[FilmPicture]:
    return list(decode_film(path, "video", FilmLimits(**limits)))


def test_a_film_is_turned_upright_and_timed(tmp_path: Path) -> None:
    """By its display matrix, which is patched in: a quarter to the right."""
    content = filmed(tmp_path / "film.mp4").read_bytes()
    unit = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    quarter = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    place = content.index(unit, content.index(b"tkhd"))
    (tmp_path / "turned.mp4").write_bytes(
        content[:place] + quarter + content[place + len(quarter) :]
    )
    upright, turned = (decoded(tmp_path / f"{name}.mp4") for name in ("film", "turned"))
    assert upright[0].pixels().shape == (96, 64, 3)
    assert turned[0].pixels().shape == (64, 96, 3)
    np.testing.assert_allclose([each.time for each in upright], np.arange(6) / 25.0, atol=1e-6)


@pytest.mark.parametrize("ending", FILMS)
def test_films_of_all_endings_are_read_by_their_content(ending: str, tmp_path: Path) -> None:
    """WebM as browsers record it: as it goes, without a duration, at uneven times."""
    av = pytest.importorskip("av")
    moments = [0, 31, 66, 99, 240]  # ms
    path = tmp_path / f"film{ending}"
    is_webm = ending == ".webm"
    with av.open(str(path), "w", options={"live": "1"} if is_webm else {}) as film:
        stream = film.add_stream("libvpx" if is_webm else "mpeg4", rate=25)
        stream.width, stream.height = 64, 96
        stream.pix_fmt = "yuv420p"
        if is_webm:
            stream.codec_context.time_base = Fraction(1, 1000)
        for number, moment in enumerate(moments):
            frame = av.VideoFrame.from_ndarray(np.full((96, 64, 3), 40 * number, np.uint8))
            if is_webm:
                frame.time_base = Fraction(1, 1000)
                frame.pts = moment
            film.mux(stream.encode(frame))
        film.mux(stream.encode())
    renamed = path.rename(tmp_path / "film")
    assert is_film(renamed)
    times = [each.time for each in decoded(renamed)]
    expected = np.array(moments) / 1000 if is_webm else np.arange(len(moments)) / 25.0
    np.testing.assert_allclose(np.array(times) - times[0], expected, atol=2e-3)


def test_what_is_no_video_is_told_while_it_is_decoded(tmp_path: Path) -> None:
    film = filmed(tmp_path / "film.mp4", 100)
    content = film.read_bytes()
    cut = tmp_path / "cut.mp4"
    for part in (0.9, 0.5, 0.02):  # the index is in front
        cut.write_bytes(content[: int(part * len(content))])
        with pytest.raises(InputError) as error:
            decoded(cut)
        assert error.value.code == "video.unreadable"
    for limits, code in (
        ({"most_frames": 50}, "long"),
        ({"most_frames": 20}, "long"),
        ({"most_pixels": 100}, "size"),
        ({"least_side": 65}, "size"),
    ):
        with pytest.raises(InputError) as error:
            decoded(film, **limits)
        assert error.value.code == f"video.{code}"


@pytest.mark.parametrize(
    ("content", "taken"),
    [(b"", True), (b"\xff\xfe" * 40, True), (b"Time\0", True), (b"Timecode,Seen\n", False)],
)
def test_what_is_called_a_film_and_is_no_text_is_taken_for_one(
    content: bytes, taken: bool, tmp_path: Path
) -> None:
    (tmp_path / "film.MP4").write_bytes(content)
    assert is_film(tmp_path / "film.MP4") == taken


def test_a_film_of_sound_alone_is_none(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "sound.mp4"), "w") as file:
        stream = file.add_stream("aac", rate=48000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 48000
        file.mux(stream.encode(frame))
        file.mux(stream.encode())
    with pytest.raises(InputError, match="no pictures") as error:
        decoded(tmp_path / "sound.mp4")
    assert error.value.code == "video.unreadable"


def test_nothing_but_the_file_is_opened(tmp_path: Path) -> None:
    """Playlists and lists are no films, whatever they are called, and nobody is connected to."""
    film = filmed(tmp_path / "film.mp4")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        address = f"http://127.0.0.1:{server.getsockname()[1]}/film.mp4"
        texts = {
            "list.mp4": f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{address}\n",
            "local.mov": f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{film}\n",
            "concat.mp4": f"ffconcat version 1.0\nfile '{film}'\n",
            "list.csv": f"#EXTM3U\n{address}\n",
        }
        for name, text in texts.items():
            path = tmp_path / name
            path.write_text(text)
            assert is_film(path)
            with pytest.raises(InputError) as error:
                decoded(path)
            assert error.value.code == "video.unreadable"
        named = tmp_path / "named.mov"  # a track whose data are in another file, by its address
        named.write_bytes(film.read_bytes().replace(b"url \0\0\0\1", b"url \0\0\0\0"))
        decoded(named)
        with pytest.raises(TimeoutError):
            server.accept()
