"""A service with rigs in it, and a browser that can draw them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import uvicorn

from service.app import create_app
from service.queue import table
from service.settings import Settings
from service.store.database import Store
from service.store.models import DEFAULT_TENANT, Artifact, Job, Rig, Subject
from solver.jobs.marker_frames import MarkerView
from solver.rig.frames import MarkerFrame, SequenceFrame
from solver.rig.frames.animation_gltf import AnimatedSkin
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.similarity import IDENTITY
from solver.storage import read_container, write_container
from solver.surface import Floats
from tests.browser.sample_rig import Sample, write_sample
from tests.browser.stage import CHROMIUM
from tests.servers import unavailable

FLAGS = (
    "--no-sandbox",
    "--disable-quic",
    "--disable-background-networking",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
PARTS = ("view.bin", "inside.bin", "preview.bin")
SOLVED = ("model.npz", "rig.npz")
SECONDS = 30.0
CERTIFICATE = {
    "verdict": "usable",
    "warnings": [],
    "checks": [
        {
            "verdict": "usable",
            "title": "Mean distance",
            "value": 0.9,
            "unit": "mm",
            "worst": "smile",
            "meaning": "how near the skin is",
            "advice": "scan it again",
        }
    ],
}


@dataclass(frozen=True)
class Place:
    """A running service with two rigs; ``first`` has all files, ``second`` no sliders."""

    url: str
    key: str
    sample: Sample
    first: str
    second: str
    old: str
    take: str
    frames: Floats
    markers: MarkerSet
    check: str  # a job that proposed them
    marked: str  # a job that fitted a take of them
    store: Store
    sliders: Path  # a preview.bin for the second


@contextmanager
def served_rigs(folder: Path) -> Iterator[Place]:
    """Serve the API with rigs of two people, one that is too old to be shown, and a sequence."""
    settings = Settings(data_dir=folder / "data", port=0)
    app = create_app(settings)
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_config=None))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    until(lambda: server.started)
    store = app.state.store.of(DEFAULT_TENANT)
    sample = write_sample(folder / "a")
    files = [folder / "a" / name for name in PARTS]
    files.append(_by_tracks(folder / "a"))
    subject, first = put_rig(store, "Ada", files, {**sample.summary(), **CERTIFICATE})
    other = write_sample(folder / "b", subject="B")
    files = [folder / "b" / name for name in (*PARTS[:2], *SOLVED)]
    for name in SOLVED:
        (folder / "b" / name).write_bytes(b"x")
    _, second = put_rig(store, "Berta", files, other.summary())
    _, old = put_rig(store, "Cleo", [], {})
    glb, frames = _sequence(folder, sample)
    pulls = _contractions(folder / "contractions.bin", sample, len(frames))
    take = put_job(store, subject, "fit_sequence", [glb, pulls], {"performance": "take 7"}, first)
    markers = _marker_set(sample)
    markers.save(folder / "markers.json")
    _marker_view(folder / "markers.bin", markers, frames)
    report = {"verdict": "usable", "findings": []}
    check = put_job(store, subject, "check_markers", [folder / "markers.json"], report, first)
    files = [glb, folder / "markers.bin"]
    marked = put_job(store, subject, "fit_markers", files, {"performance": "take 8"}, first)
    port = server.servers[0].sockets[0].getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    try:
        key = settings.admin_key.read_text()
        rigs = first, second, old
        jobs = take, frames, markers, check, marked
        yield Place(url, key, sample, *rigs, *jobs, store, folder / "b" / PARTS[2])
    finally:
        server.should_exit = True
        thread.join(10)


@contextmanager
def drawing_browser() -> Iterator[Any]:
    """Start Chromium with WebGL by the processor; skips where it or playwright is missing."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not CHROMIUM.exists():
        unavailable(f"there is no {CHROMIUM}")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=str(CHROMIUM), args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def until(condition: Callable[[], bool], seconds: float = SECONDS) -> None:
    """Wait until ``condition`` holds; fails after ``seconds``."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _by_tracks(folder: Path) -> Path:
    """Write what tracks make of a sample's expressions: half of them."""
    found = read_container(folder / "view.bin")
    path = folder / "view_T.bin"
    halved = {
        name: array / 2 if name.startswith("skin/") else array
        for name, array in found.arrays.items()
    }
    header = {name: found.header[name] for name in found.header if name != "arrays"}
    write_container(path, header, halved)
    return path


def _sequence(folder: Path, sample: Sample) -> tuple[Path, Floats]:
    """Write a sequence from neutral through two expressions, and return its skins (f, n, 3)."""
    still = SequenceFrame(
        *(0, np.zeros((1, 6)), np.zeros(5), np.zeros(6), 0, 1, 0.1), *("fitted", 0.1, 0.2, 0.3, 1.0)
    )
    skin = AnimatedSkin(sample.neutral)
    shares = np.linspace(0, 1, 9)
    frames = np.array(
        [
            sample.neutral.vertices + share * sample.skin[0] + share**2 * sample.skin[1]
            for share in shares
        ]
    )
    for number, places in enumerate(frames):
        skin.add(replace(still, frame=number), places)
    path = folder / "sequence.glb"
    skin.write(path, fps=30)
    return path, frames


def _contractions(path: Path, sample: Sample, frames: int) -> Path:
    """Write a take in which one side's muscle contracts, the other one's is at its bound."""
    found = np.zeros((frames, len(sample.muscles)), np.float32)
    found[:, sample.muscles.index("zygomaticus_major_l")] = np.linspace(0.0, 0.2, frames)
    found[:, sample.muscles.index("zygomaticus_major_r")] = -0.05
    arrays = {"contraction": found, "jaw": np.zeros((frames, 5), np.float32)}
    write_container(path, {"muscles": list(sample.muscles)}, arrays)
    return path


def _marker_set(sample: Sample, count: int = 24) -> MarkerSet:
    """Return markers on triangles over the front of the face, two millimetres off the skin."""
    surface = sample.neutral
    centres = surface.vertices[surface.faces].mean(axis=1)
    front = np.flatnonzero(centres[:, 2] > np.quantile(centres[:, 2], 0.75))
    chosen = [int(front[0])]
    while len(chosen) < count:
        away = np.linalg.norm(centres[front][:, None] - centres[chosen][None], axis=2).min(axis=1)
        chosen.append(int(front[np.argmax(away)]))
    labels = [f"M{number:02d}" for number in range(count - 2)] + ["LCheek", "RCheek"]
    markers = tuple(
        Marker(labels[number], tuple(surface.faces[face].tolist()), (0.4, 0.3, 0.3), 2.0)
        for number, face in enumerate(chosen)
    )
    return MarkerSet(markers, IDENTITY, "0" * 64)


def _marker_view(path: Path, markers: MarkerSet, frames: Floats) -> None:
    """Write a fitted take: a gap, an outlier, a swap, and a muscle that is held."""
    view = MarkerView(markers.labels, ["frontalis_l", "frontalis_r", "risorius_l"])
    count = len(markers.labels)
    for number, skin in enumerate(frames):
        states = ["seen"] * count
        seen = np.einsum("kc,kcd->kd", markers.weights, skin[markers.vertices])
        off = np.random.default_rng(number).normal(0.0, 0.5, (count, 3))
        if 2 <= number < 6:
            states[3] = "missing"
            off[3] = np.nan
        if number == 4:
            states[5] = "outlier"
            off[5] = [0.0, 9.0, 0.0]
            states[7] = states[8] = "swapped"
        frame = MarkerFrame(
            *(number, np.zeros((3, 6)), np.zeros(5), np.zeros(6), 0, 2, 0.05),
            *("fitted", 0.5, 0.9, 1.2, 0.9),
            marker_mm=np.linalg.norm(off, axis=1),
            marker_weight=np.ones(count),
            marker_state=tuple(states),
            sd=np.ones(23),
            information=np.ones(23),
            contraction_sd=np.full(3, 0.1),
            held=np.array([0.0, 0.0, float(number > 5)]),
            tracks=np.zeros(0),
            mandible=np.eye(4),
        )
        view.add(frame, seen, seen + off)
    view.write(path, 30.0)


def put_rig(
    store: Store, subject: str, files: Iterable[Path], summary: dict[str, Any]
) -> tuple[str, str]:
    """Put a rig with its files into the store as a worker does; returns subject's and rig's id."""
    with store.write() as session:
        person = Subject(name=subject)
        session.add(person)
        session.flush()
        subject_id = person.id
    job_id = put_job(store, subject_id, "fit_geometry", files, summary)
    with store.write() as session:
        rig = Rig(
            subject_id=subject_id,
            job_id=job_id,
            model_job_id=job_id,
            expressions=[],
            summary=summary,
        )
        session.add(rig)
        session.flush()
        return subject_id, rig.id


def put_job(
    store: Store,
    subject_id: str,
    kind: str,
    files: Iterable[Path],
    summary: dict[str, Any],
    rig_id: str | None = None,
    options: dict[str, Any] | None = None,
) -> str:
    """Put a job that succeeded and left ``files``; returns its id."""
    request = {
        "kind": kind,
        "subject_id": subject_id,
        "captures": [],
        "rig_id": rig_id,
        "options": options or {},
    }
    with store.write() as session:
        job = Job(
            subject_id=subject_id,
            kind=kind,
            queue="long",
            request=request,
            inputs=[],
            max_attempts=3,
        )
        table.create(session, job)
        job_id = job.id
    end_job(store, job_id, start_job(store, job_id), files, summary)
    return job_id


def start_job(store: Store, job_id: str) -> int:
    """Take a job as a worker does; returns the attempt."""
    with store.write() as session:
        claim = table.take(session, job_id, "test", 60)
        assert claim
        return claim.attempt


def end_job(
    store: Store, job_id: str, attempt: int, files: Iterable[Path], summary: dict[str, Any]
) -> None:
    """Let a job that runs succeed and leave ``files``."""
    with store.write() as session:
        left = [_artifact(store, job_id, path) for path in files]
        assert table.succeed(session, job_id, attempt, left, summary=summary)


def _artifact(store: Store, job_id: str, path: Path) -> Artifact:
    blob = store.files.put(path)
    return Artifact(
        job_id=job_id,
        name=path.name,
        size=blob.size,
        sha256=blob.sha256,
        media_type="application/octet-stream",
    )
