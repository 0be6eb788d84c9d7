"""The live view in Chromium, with a stand-in for the session's WebSocket: what comes is drawn."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.kinds.live_messages import HELD, FollowedFrame
from solver.storage import write_container
from solver.surface import Floats
from tests.browser.rig_place import SECONDS, Place, put_job, until

pytestmark = pytest.mark.slow

SESSION = "0f0e0d0c-0000-4000-8000-000000000001"
CLOSE_MM = 0.01
MUSCLES = [f"muscle_{number}" for number in range(20)]
Page = Any


class Session:
    """A live session as the page meets it: routes and a WebSocket, answered by the test."""

    def __init__(self, place: Place, view: Path) -> None:
        self.place = place
        self.basis = place.sample.basis.astype(np.float16)
        self.shapes = len(self.basis)
        self.view = view
        self.asked: list[tuple[str, Any]] = []  # of recording, by the page
        self.sockets: list[Any] = []
        self.tickets: list[dict[str, Any]] = []
        write_container(view, {}, {"basis": self.basis})

    def serve(self, page: Page) -> None:
        """Answer the page's requests about the session."""
        about = {
            "id": SESSION,
            "rig_id": self.place.first,
            "state": "running",
            "source": "markers",
            "created_at": "2026-11-28T12:00:00Z",
        }
        page.route(
            re.compile(r"/v1/live(\?|$)"),
            lambda route: route.fulfill(json={"items": [about], "next": None}),
        )
        page.route(f"**/v1/live/{SESSION}/tickets", self._give_ticket)
        page.route(f"**/v1/live/{SESSION}/view", lambda route: route.fulfill(path=self.view))
        page.route(f"**/v1/live/{SESSION}/recording", self._record)
        page.route_web_socket(re.compile(f"/v1/live/{SESSION}/frames"), self._open)

    def tell(self, said: dict[str, Any]) -> None:
        """Say something to the page."""
        self.sockets[-1].send(json.dumps(said))

    def ready(self) -> None:
        """Say that frames may come."""
        layout = {"head": [4, 4], "jaw": [5], "values": [2], "amounts": [self.shapes]}
        layout["contractions"] = [len(MUSCLES)]
        self.tell(
            {
                "type": "ready",
                "source": "markers",
                "layout": [{"name": name, "shape": shape} for name, shape in layout.items()],
                "sliders": ["jawOpen", "mouthSmileLeft"],
                "muscles": MUSCLES,
            }
        )

    def frame(self, number: int, amounts: Floats, pulls: Floats, flags: int = 0) -> None:
        """Send a followed frame."""
        parts = [np.eye(4).ravel(), np.zeros(5), np.zeros(2), amounts, pulls]
        numbers = np.concatenate(parts).astype("<f4").tobytes()
        frame = FollowedFrame(number, number / 60, 4.5, 0.06, 0.21, 3, flags, numbers)
        self.sockets[-1].send(frame.pack())

    def _give_ticket(self, route: Any) -> None:
        self.tickets.append(route.request.post_data_json)
        url = f"/v1/live/{SESSION}/frames?ticket=ticket-{len(self.tickets)}"
        route.fulfill(json={"url": url}, status=201)

    def _record(self, route: Any) -> None:
        self.asked.append((route.request.method, route.request.post_data_json))
        route.fulfill(json=route.request.post_data_json, status=202)

    def _open(self, socket: Any) -> None:
        self.sockets.append(socket)
        socket.on_message(lambda _: None)  # nothing is passed on to the service


@pytest.fixture
def session(place: Place, tmp_path: Path) -> Session:
    return Session(place, tmp_path / "live_view.bin")


@pytest.fixture
def rig(place: Place, drawing: Any, session: Session) -> Iterator[Callable[..., Page]]:
    """Open the rig with a session; an error in the page's console fails the test."""
    faults: list[str] = []
    context = drawing.new_context(viewport={"width": 1400, "height": 900})
    context.set_default_timeout(SECONDS * 1000)

    def open_rig(query: str = "") -> Page:
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda said: said.type == "error" and faults.append(said.text))
        session.serve(page)
        page.goto(f"{place.url}/rigs/{place.first}{query}#key={place.key}")
        until(lambda: page.evaluate("performance.getEntriesByName('rig-shown').length > 0"))
        page.evaluate(
            "document.querySelector('.rig').addEventListener('posed', (event) => {"
            " window.posed = Array.from(event.detail.places); })"
        )
        return page

    yield open_rig
    context.close()
    assert faults == []


def _posed(page: Page) -> Floats:
    return np.array(page.evaluate("window.posed ?? []")).reshape(-1, 3)


def _picture(page: Page, name: str) -> None:
    """Keep what the page shows, for somebody who wants to look at it."""
    if folder := os.environ.get("MYOFACE_PICTURES"):
        page.screenshot(path=Path(folder) / f"{name}.png")


def test_the_face_is_where_the_session_has_it(
    place: Place, rig: Callable[..., Page], session: Session
) -> None:
    page = rig()
    page.get_by_role("tab", name="Live").click()
    page.get_by_label("Session").select_option(SESSION)
    until(lambda: _pumped(page, session.sockets))
    assert session.tickets == [{"watch": True}]

    session.tell({"type": "preparing", "phase": "samples", "fraction": 0.4})
    page.get_by_text("Samples").wait_for()
    session.ready()
    page.get_by_text("Live", exact=True).nth(1).wait_for()
    pulls = np.linspace(0.0, 0.4, len(MUSCLES))
    for number in range(60):
        amounts = np.full(session.shapes, 20.0) * np.sin(number / 10)
        session.frame(number, amounts, pulls * abs(np.sin(number / 10)), HELD * (20 < number < 30))
        page.wait_for_timeout(15)
    _picture(page, "live")
    facts = page.locator(".live-facts").inner_text()
    assert "0.06 mm, 95 % within 0.21" in facts
    assert "4.5 ms, 95 % within 4.5" in facts
    late = re.search(r"here after, at least\s+([\d.]+) ms, 95 % within ([\d.]+)", facts, re.I)
    assert late is not None
    assert 4.5 <= float(late[1]) <= float(late[2])

    expected = place.sample.neutral.vertices + np.tensordot(amounts, session.basis, 1)
    until(lambda: _pumped(page) and bool(np.allclose(_posed(page), expected, atol=CLOSE_MM)))
    assert page.get_by_label("Who contracts now").locator("li").count() == 12
    assert f"live={SESSION}" in page.url

    page.get_by_role("tab", name="Expressions").click()
    page.get_by_role("button", name="Neutral").click()
    until(lambda: np.allclose(_posed(page), place.sample.neutral.vertices, atol=CLOSE_MM))


WAYS = """async () => {
    const { LiveFigures } = await import("/static/js/rig/live/figures.js");
    const figures = new LiveFigures();
    const frame = (number, seconds, more = {}) =>
        ({ number, seconds, solveMs: 4, dropped: 0, hasOtherClock: false, ...more });
    // captured every 10 ms; every tenth comes 30 ms later than the others
    const late = (number) => 7000 + 10 * number + (number % 10 === 9 ? 30 : 0);
    for (let number = 0; number < 100; number++)
        figures.came(frame(number, number / 100), late(number));
    const even = figures.now(8000).way;
    figures.came(frame(100, 900, { hasOtherClock: true }), 8010);
    const after = figures.now(8010).way;
    return [even, after, figures.now(8010 + 5001).way];
}"""


def test_how_late_faces_are_is_told_whatever_the_stations_clock_says(
    rig: Callable[..., Page],
) -> None:
    even, after, over = rig().evaluate(WAYS)
    assert even == pytest.approx({"p50": 4.0, "p95": 34.0})
    assert after == pytest.approx({"p50": 4.0, "p95": 4.0})
    assert np.isnan(over["p50"])


def test_a_take_is_recorded_and_named(rig: Callable[..., Page], session: Session) -> None:
    page = rig(f"?live={SESSION}")
    until(lambda: _pumped(page, session.sockets))
    session.ready()
    name = page.get_by_label("Name of the take")
    name.fill("scene 4 take 9")
    page.get_by_role("button", name="Record").click()
    until(lambda: _pumped(page, session.asked))
    assert session.asked == [("PUT", {"name": "scene_4_take_9"})]
    session.tell({"type": "recording", "name": "scene_4_take_9"})
    page.get_by_role("button", name="Stop").click()
    until(lambda: _pumped(page) and len(session.asked) == 2)
    assert session.asked[1] == ("DELETE", None)
    take = {"name": "scene_4_take_9", "file": "scene_4_take_9.npz", "frames": 120, "seconds": 2.0}
    session.tell({"type": "take", **take})

    page.get_by_role("list", name="Takes").get_by_text("120 frames, 2.0 s").wait_for()
    assert name.input_value() == "scene_4_take_10"
    _picture(page, "live-take")


def test_a_broken_line_is_mended_with_a_new_ticket(
    rig: Callable[..., Page], session: Session
) -> None:
    page = rig(f"?live={SESSION}")
    until(lambda: _pumped(page, session.sockets))
    session.ready()
    session.sockets[0].close()

    until(lambda: _pumped(page) and len(session.sockets) == 2)

    assert len(session.tickets) == 2
    session.ready()
    session.tell({"type": "ended", "reason": "asked"})
    page.get_by_text("The session has ended: asked.").wait_for()


def test_a_stored_take_is_solved_exactly(
    place: Place, rig: Callable[..., Page], tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    files = [tmp_path / "take_1.csv", tmp_path / "live_takes.npz"]
    for file in files:
        file.write_bytes(rng.bytes(100))
    take = {"name": "take 1", "file": "take_1.csv", "frames": 60, "seconds": 1.0}
    subject = _subject_of(place)
    summary = {"takes": [take]}
    options = {"source": "weights"}
    job = put_job(place.store, subject, "live_session", files, summary, place.first, options)
    page = rig(f"?live={SESSION}")

    page.get_by_role("button", name="Solve exactly take 1").click()

    dialog = page.get_by_role("dialog")
    dialog.get_by_role("heading", name="Animate by a recording").wait_for()
    assert f'"asset": "take_1_{job[:8]}"' in dialog.locator("textarea").first.input_value()
    _picture(page, "live-solve")
    asked: list[dict[str, Any]] = []

    def submit(route: Any) -> None:
        if route.request.method != "PUT":
            route.continue_()
            return
        asked.append(route.request.post_data_json)
        route.fulfill(json={"id": job}, status=201)

    page.route("**/v1/jobs/*", submit)
    dialog.get_by_role("button", name="Submit").click()
    page.wait_for_url(f"**/jobs/{job}")
    assert asked[0]["from_jobs"] == [{"job": job, "artifact": "live_takes.npz"}]


def test_an_exact_job_tells_how_far_live_was_off(place: Place, rig: Callable[..., Page]) -> None:
    told = {"p50_mm": 0.06, "p95_mm": 0.21}
    found = {"p50_mm": 0.08, "p95_mm": 0.25, "max_mm": 0.4, "max_frame": 17}
    live = {"take": "walk", "frames": 120, "mean_mm": 0.1, **found, "told": told}
    subject = _subject_of(place)
    job = put_job(place.store, subject, "fit_markers", [], {"live": live}, place.first)
    page = rig()
    page.goto(f"{place.url}/jobs/{job}")
    page.get_by_text(
        "Live was off 0.08 mm, 95 % within 0.25, at most 0.4 mm in frame 17, of 120 frames of walk."
        " At the end it told 0.06 mm, 95 % within 0.21."
    ).wait_for()
    _picture(page, "live-off")


def _subject_of(place: Place) -> str:
    from service.store.models import Rig

    with place.store.read() as session:
        rig = session.get(Rig, place.first)
        assert rig is not None
        return rig.subject_id


def _pumped(page: Page, found: list[Any] | None = None) -> bool:
    """Let the page's events reach the test; returns whether ``found`` has anything."""
    page.wait_for_timeout(20)
    return found is None or bool(found)
