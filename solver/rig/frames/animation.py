"""The result of a simulation: an animated face for tools, arrays, pictures and a film.

All files are documented in docs/guide/simulation.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from importlib.util import find_spec
from itertools import repeat
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from solver.anatomy.tetrahedra import volume_ml
from solver.drawing.head import THREE_QUARTER, DrawnHead, face_camera
from solver.drawing.render import DrawnBody, Lit, Pixels, render_bust
from solver.drawing.sheet import MARGIN, Column, SheetLayout, draw_sheet
from solver.errors import InputError
from solver.model import SubjectModel
from solver.rig.frames import FORMAT as FRAMES_FORMAT
from solver.rig.frames import FrameRecord, pack, read_chunks, unpack
from solver.rig.frames.animation_gltf import write_animation_glb
from solver.rig.frames.gltf import Solid
from solver.rig.frames.joints import Joints
from solver.rig.frames.read_back import Comparison
from solver.rig.frames.skin_basis import Singles
from solver.scene.places import SceneObject
from solver.similarity import IDENTITY, Similarity, small_motion
from solver.simulation.forces import FleshMotion
from solver.storage import write_json
from solver.surface import Floats, Ints, Surface


@dataclass(frozen=True)
class MotionRecord(FrameRecord):
    """One frame of a simulation; ``halvings`` and ``residual`` are those of its ``Stepped``."""

    time: float  # s
    eyes: Floats  # (2, 3) rotation vectors in the head's frame, the subject's left eye first
    moved: Floats  # (p, 3) mm: the flesh's vertices off their rest, in the head's frame
    penetration_mm: float  # of skin in teeth, in other skin or in objects, at the worst
    behind_teeth: int  # number of the lips' vertices
    halvings: int
    residual: float

    ARRAYS: ClassVar[tuple[str, ...]] = (*FrameRecord.ARRAYS, "eyes")
    PACKED: ClassVar[Mapping[str, str]] = {"moved": "x"}

    @property
    def into_world(self) -> Similarity:
        """Return the head's motion into the world."""
        return small_motion(self.head)


def motion_values(scene: str, motion: FleshMotion, picture: str | None) -> dict[str, Any]:
    """Return a file's values beside its frames, the last of which ended in ``motion``.

    ``scene`` is the hash of all that is simulated, ``picture`` a JPEG of that frame in base 64.
    """
    state = {"x": pack(motion.x, "<f8"), "v": pack(motion.v, "<f8")}
    return {"scene": scene, "state": state, "picture": picture}


def read_motion(folder: Path, scene: str, rest: Floats) -> tuple[list[MotionRecord], FleshMotion]:
    """Return a simulation's frames and where they ended; none, at rest, if there is no folder.

    Raises :class:`InputError`: ``simulate.frames`` as :func:`read_chunks`,
    ``simulate.other_scene`` if the frames are another scene's.
    """
    motions = [FleshMotion(rest, np.zeros_like(rest), IDENTITY)]

    def take(values: Mapping[str, Any], frames: Sequence[MotionRecord]) -> None:
        x, v = (unpack(values["state"][name], "<f8") for name in ("x", "v"))
        motions.append(FleshMotion(x, v, frames[-1].into_world))
        if values["scene"] != scene:
            message = "the frames that are ready belong to another scene, person or rig: begin anew"
            raise InputError("simulate.other_scene", message)

    frames = read_chunks(
        folder, MotionRecord, "simulate.frames", lambda frame: frame.moved.shape == rest.shape, take
    )
    return frames, motions[-1]


def motion_report(frames: Sequence[MotionRecord], model: SubjectModel) -> dict[str, Any]:
    """Return the figures of a simulation; lengths in mm, times in s or ms, volumes in ml.

    The flesh's volume is compared with that of the ``model`` at rest.
    """
    seconds = [frame.seconds for frame in frames]
    at_rest = volume_ml(model.rest, model.tets)
    volumes = [volume_ml(model.rest + frame.moved, model.tets) for frame in frames]
    changes = [100.0 * (volume / at_rest - 1.0) for volume in volumes]
    furthest = [float(np.linalg.norm(frame.moved, axis=1).max()) for frame in frames]
    return {
        "format": FRAMES_FORMAT,
        "frames": len(frames),
        "duration": frames[-1].time - frames[0].time,
        "penetration_max_mm": max(frame.penetration_mm for frame in frames),
        "behind_teeth": max(frame.behind_teeth for frame in frames),
        "inverted": max(frame.inverted for frame in frames),
        "moved_max_mm": round(max(furthest), 3),
        "volume_ml": round(at_rest, 2),
        "volume_change_percent": [round(min(changes), 3), round(max(changes), 3)],
        "iterations": round(float(np.mean([frame.iterations for frame in frames])), 2),
        "halvings": sum(frame.halvings for frame in frames),
        "frame_ms": round(1e3 * float(np.median(seconds)), 1),
        "frame_max_ms": round(1e3 * max(seconds), 1),
        "seconds": round(sum(seconds), 2),
    }


FORMAT = 1  # of animation.npz
TRACKS = (  # taken of every frame, see MotionRecord
    *("time", "activations", "jaw", "head", "eyes"),
    *("penetration_mm", "behind_teeth", "inverted", "iterations", "seconds"),
)
NO_ARRAYS: Mapping[str, np.ndarray] = MappingProxyType({})
FASTEST = 1  # level of compression: skins hardly shrink, however long one tries


def write_animation_npz(
    path: Path,
    muscles: Sequence[str],
    frames: Sequence[MotionRecord],
    skins: Singles,
    vertices: Ints,
    more: Mapping[str, np.ndarray] = NO_ARRAYS,
) -> None:
    """Write what drove ``frames``, and ``vertices`` (k,) of their skins in the world, mm.

    ``skins`` (f, v, 3), in the head's frame, are read one by one, so that they may be mapped;
    ``more`` arrays have a row for each frame.
    """
    arrays = {name: np.array([getattr(frame, name) for frame in frames]) for name in TRACKS}
    arrays |= more
    names = np.array(muscles, dtype=np.str_)
    arrays |= {"format": np.array(FORMAT), "muscles": names, "vertices": vertices}
    with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=FASTEST) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w") as stream:
                np.lib.format.write_array(stream, values, allow_pickle=False)
        with archive.open("skin.npy", "w", force_zip64=True) as stream:
            header = {"descr": "<f4", "fortran_order": False}
            shape = (len(frames), len(vertices), 3)
            np.lib.format.write_array_header_1_0(stream, {**header, "shape": shape})
            for frame, skin in zip(frames, skins, strict=True):
                placed = small_motion(frame.head)(skin[vertices].astype(np.float64))
                stream.write(placed.astype("<f4").tobytes())


def compare_animation_npz(
    path: Path, frames: Sequence[MotionRecord], skins: Singles, vertices: Ints
) -> dict[str, Any]:
    """Return how far the skins of ``animation.npz`` are off, read back frame by frame.

    Raises :class:`~solver.errors.SolveError` (``file.differs``) where that is too far; a frame is
    its position among all, a vertex its position among ``vertices``.
    """
    found = Comparison(path.name)
    size = 12 * len(vertices)
    with ZipFile(path) as archive, archive.open("skin.npy") as stream:
        np.lib.format.read_magic(stream)
        np.lib.format.read_array_header_1_0(stream)
        for number, (frame, skin) in enumerate(zip(frames, skins, strict=True)):
            shown = np.frombuffer(stream.read(size), "<f4").reshape(-1, 3)
            found.add(number, shown, frame.into_world(skin[vertices].astype(np.float64)))
    return found.figures()


# Frames as pictures, with what the face meets.

OBJECT = (0.35, 0.45, 0.52)  # linear colour of what the face meets
OBJECT_OPACITY = 0.3  # the face is seen through it


class Filming:
    """Draws a subject's skins, all from where the neutral is seen."""

    def __init__(self, model: SubjectModel) -> None:
        self._head = DrawnHead(model.skin)
        self._cameras = {
            yaw: face_camera(model.skin.vertices, model.face, yaw) for yaw in (0.0, THREE_QUARTER)
        }

    def light(self, skin: Floats) -> Floats:
        """Return the light on a skin (v, 3), for pictures of it and of skins that are alike."""
        return self._head.lit(skin).light

    def picture(
        self,
        skin: Floats,
        light: Floats,
        size: tuple[int, int],
        *,
        objects: Sequence[Surface] = (),
        yaw: float = 0.0,
    ) -> Pixels:
        """Return a skin (v, 3) in the world, mm, with objects half transparent before it.

        ``size`` is (width, height); ``yaw`` is 0 for the front or :data:`THREE_QUARTER`.
        """
        bodies = [self._head.body(self._head.lit(skin, light))]
        for each in objects:
            colour = np.broadcast_to(OBJECT, each.vertices.shape)
            bodies.append(DrawnBody(Lit(each), colour, opacity=OBJECT_OPACITY))
        return render_bust(bodies, self._cameras[yaw], size)


@dataclass(frozen=True)
class Shot:
    """A moment of an animation: its ``caption``, skin (v, 3) and objects in the world, mm."""

    caption: str
    skin: Floats
    objects: tuple[Surface, ...] = ()


def contact_sheet(
    filming: Filming, shots: Sequence[Shot], title: str, detail: str, path: Path
) -> None:
    """Draw shots in rows of four, each from the front and from the side."""
    layout = SheetLayout(cell=(300, 360), label=MARGIN, columns=4, foot=MARGIN)
    columns = []
    for shot in shots:
        light = filming.light(shot.skin)
        images = [
            filming.picture(shot.skin, light, layout.cell, objects=shot.objects, yaw=yaw)
            for yaw in (0.0, THREE_QUARTER)
        ]
        columns.append(Column(shot.caption, images))
    draw_sheet(path, title, detail, ("", ""), columns, layout, scale_mm=None)


# of films, tried in this order, the best first; not every FFmpeg has it
CODECS = {"libx264": {"crf": "18", "preset": "medium"}, "mpeg4": {"qscale": "3"}}


TICK = Fraction(1, 60_000)  # s, of films whose frames are not even: MPEG-4 has at most 65535


def check_video() -> None:
    """Raise :class:`InputError` (``options.video``) where films cannot be written."""
    if find_spec("av") is None:
        message = "a film needs PyAV, which is not installed: pip install 'myoface[video]'"
        raise InputError("options.video", message)


def write_video(
    path: Path,
    pictures: Iterable[Pixels],
    size: tuple[int, int],
    fps: float,
    times: Iterable[float] | None = None,
) -> None:
    """Write sRGB ``pictures`` (h, w, 3) from 0 to 1, w and h even; see :func:`check_video`.

    They come ``fps`` a second, or at ``times`` in s, as those of a recording whose frames are not
    even.
    """
    check_video()
    import av

    codec = next(name for name in CODECS if name in av.codecs_available)
    rate = Fraction(fps).limit_denominator(1001)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as film:
        stream = film.add_stream(codec, rate=rate, options=CODECS[codec])
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        if times is not None:
            stream.codec_context.time_base = TICK
        moments: Iterator[float | None] = repeat(None) if times is None else iter(times)
        for picture, moment in zip(pictures, moments):  # noqa: B905
            pixels = np.ascontiguousarray((picture * 255.0 + 0.5).astype(np.uint8))
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            if moment is not None:
                frame.time_base = TICK
                frame.pts = round(moment / TICK)
            film.mux(stream.encode(frame))
        film.mux(stream.encode())


@dataclass(frozen=True)
class FilmingOptions:
    """Frames of the picture and the film."""

    shots: int = 8  # frames in the picture
    size: tuple[int, int] = (480, 576)  # of the film, pixels
    lit_every: int = 6  # of so many frames, one is lit by itself
    single_fps: float = 30.0  # of an animation of one frame


def write_animation(
    out: Path,
    model: SubjectModel,
    frames: Sequence[MotionRecord],
    skins: Singles,
    *,
    title: str,
    report: dict[str, Any],
    vertices: Ints,
    muscles: Sequence[str] | None = None,
    arrays: Mapping[str, np.ndarray] = NO_ARRAYS,
    objects: Sequence[SceneObject] = (),
    joints: Joints | None = None,
    video: bool = False,
    options: FilmingOptions = FilmingOptions(),
) -> list[Path]:
    """Write ``frames``, whose ``skins`` (f, v, 3) are in the head's frame, mm; return the paths.

    ``animation.npz`` has the ``vertices`` (k,) of the skin, the names of the ``muscles``, those
    of the model by default, and more ``arrays``. ``objects`` are what the face meets, ``joints``
    of a neck carry the skin in ``animation.glb``; ``video`` adds ``animation.mp4``, see
    :func:`check_video`.
    """
    table, glb, packed, sheet, film = (
        out / f"animation.{kind}" for kind in ("json", "glb", "npz", "png", "mp4")
    )
    times = np.array([frame.time for frame in frames])
    heads = np.array([frame.head for frame in frames])
    solids = [
        Solid(each.name, each.shape, np.array([each.path(time) for time in times]))
        for each in objects
    ]
    written = write_animation_glb(glb, model.skin, skins, heads, times - times[0], solids, joints)
    write_animation_npz(packed, muscles or model.muscle_names, frames, skins, vertices, arrays)
    measured = {packed.name: compare_animation_npz(packed, frames, skins, vertices)}
    figures = {**report, "glb": {**asdict(written), "bytes": glb.stat().st_size}, "files": measured}
    write_json(table, figures)
    filming = Filming(model)

    def shot(number: int) -> Shot:
        frame = frames[number]
        skin = frame.into_world(skins[number].astype(np.float64))
        return Shot(f"{frame.time:.2f} s", skin, tuple(each.at(frame.time) for each in objects))

    shown = np.unique(np.linspace(0, len(frames) - 1, options.shots).round().astype(int))
    detail = (
        f"{len(frames)} frames in {times[-1] - times[0]:.1f} s, "
        f"{sum(frame.inverted for frame in frames)} inverted tets, "
        f"skin at most {max(frame.penetration_mm for frame in frames):.2f} mm in what it meets"
    )
    contact_sheet(filming, [shot(number) for number in shown], title, detail, sheet)
    files = [table, glb, packed, sheet]
    film.unlink(missing_ok=True)  # one of another scene is not to stay beside the new files
    if video:
        files.append(film)
        pictures = _film(filming, len(frames), shot, options)
        usual = 1.0 / float(np.median(np.diff(times))) if len(times) > 1 else options.single_fps
        write_video(film, pictures, options.size, round(usual, 2), (times - times[0]).tolist())
    return files


def _film(
    filming: Filming, count: int, shot: Callable[[int], Shot], options: FilmingOptions
) -> Iterator[Pixels]:
    """Draw all frames; light, which takes longest, is interpolated between some of them."""
    light = filming.light(shot(0).skin)
    for first in range(0, count, options.lit_every):
        begin = light
        end = min(first + options.lit_every, count - 1)
        light = filming.light(shot(end).skin)
        for number in range(first, min(first + options.lit_every, count)):
            share = (number - first) / max(end - first, 1)
            now = shot(number)
            here = begin + share * (light - begin)
            yield filming.picture(now.skin, here, options.size, objects=now.objects)
