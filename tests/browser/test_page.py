"""The page in Chromium, with a running stack behind it."""

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from myoface.client.scan_packing import with_images
from tests.service_client import Studio, eventually

pytestmark = pytest.mark.slow

MB = 1_000_000
PIECE = 8 * 1024**2
SAMPLE_MS = 150_000.0  # others may want the processor while the sample is made
Show = Callable[..., Any]


def _scan(path: Path, size: int = 0, **orders: str) -> Path:
    lines = [f"# {path.name}", *(f"#! {key} {value}" for key, value in orders.items())]
    path.write_text("\n".join(lines) + "\n" + "v 0 0 0\n" * (size // 8))
    return path


def _row(page: Any, file: str) -> Any:
    return page.locator(f'tr[data-file="{file}"]')


def _drop(page: Any, paths: list[Path], on: str = ".zone") -> None:
    """Drop files or folders as the desktop does."""
    session = page.context.new_cdp_session(page)
    box = page.locator(on).bounding_box()
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + 10, "data": data}
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, **at})


def test_a_dropped_scan_set_is_uploaded_and_judged(
    show: Show, studio: Studio, tmp_path: Path
) -> None:
    folder = tmp_path / "session"
    folder.mkdir()
    neutral = _scan(folder / "Ada_neutral.obj")
    smile = _scan(folder / "Ada_smile.obj", size=9 * MB)
    kiss = _scan(folder / "Ada_kiss.obj", verdict="bad")
    (folder / "Ada_smile-landmarks.csv").write_text("sellion,0,0,0\n")
    (folder / "Ada_smile.mtl").write_text("newmtl skin\n")
    with kiss.open("a") as stream:
        stream.write("mtllib ./kiss.mtl\n")
    (folder / "kiss.mtl").write_text("newmtl skin\nmap_Kd -clamp on a kiss.png\n")
    (folder / "a kiss.png").write_bytes(b"an image")
    page = show("/queue")

    _drop(page, [folder], on="h1")

    row = _row(page, "Ada_neutral.obj")
    row.wait_for()
    assert row.get_attribute("data-role") == "neutral"
    assert page.locator("tr[data-file]").first.get_attribute("data-file") == "Ada_neutral.obj"
    assert page.get_by_label("Name of Ada_smile.obj").input_value() == "smile"
    assert "landmarks Ada_smile-landmarks.csv" in _row(page, "Ada_smile.obj").inner_text()
    assert page.get_by_text("1 file is no scan and stays here: Ada_smile.mtl").is_visible()

    page.get_by_label("Name of the new subject").fill("Ada, Monday")
    page.get_by_role("button", name="Upload 3 scans").click()

    for file, verdict in (("neutral", "Good"), ("smile", "Good"), ("kiss", "Bad: scan again")):
        _row(page, f"Ada_{file}.obj").locator(".state").get_by_text(verdict).wait_for()
    judged = _row(page, "Ada_kiss.obj")
    assert "with kiss.mtl, a kiss.png" in judged.inner_text()
    assert judged.get_by_text("Turn the head towards the lower camera").is_visible()
    picture = judged.locator("img")
    eventually(lambda: picture.evaluate("image => image.naturalWidth") == 480)

    subject = studio.get("/v1/subjects")["items"][0]
    captures = studio.get(f"/v1/subjects/{subject['id']}/captures")["items"]
    found = {capture["name"]: capture for capture in captures}
    assert subject["name"] == "Ada, Monday"
    assert found["neutral"]["role"] == "neutral"
    assert not found["smile"]["registered"]
    assert found["smile"]["landmarks"] == "Ada_smile-landmarks.csv"
    for name, path in (("neutral", neutral), ("smile", smile)):
        assert found[name]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    # as the client packs it, byte for byte
    packed = with_images(kiss, tmp_path)
    assert found["kiss"]["filename"] == packed.name == "Ada_kiss.zip"
    assert found["kiss"]["sha256"] == hashlib.sha256(packed.read_bytes()).hexdigest()


def test_a_session_is_added_in_one_call_and_becomes_a_rig(
    show: Show, studio: Studio, tmp_path: Path
) -> None:
    scans = [_scan(tmp_path / f"{name}.obj") for name in ("neutral", "smile", "kiss")]
    page = show("/upload")
    upload = page.get_by_role("button", name="Upload")
    assert upload.is_disabled()
    why = page.locator(f"#{upload.get_attribute('aria-describedby')}").inner_text()
    assert upload.get_attribute("title") == why == "Choose files or drop them here first"
    asked: list[str] = []
    page.on("request", lambda request: asked.append(f"{request.method} {request.url}"))
    page.set_input_files("#files", [str(path) for path in scans])
    page.get_by_label("Name of the new subject").fill("Noor")
    page.get_by_label("The service is to").select_option("all")
    page.get_by_role("button", name="Upload 3 scans").click()
    for name in ("neutral", "smile", "kiss"):
        _row(page, f"{name}.obj").locator(".state").get_by_text("Good").wait_for()
    page.get_by_role("link", name="Open the rig").wait_for()
    made = [each for each in asked if each.startswith("POST") and "/v1/uploads" not in each]
    assert [each.rsplit("/", 1)[1] for each in made] == ["subjects", "batches"]


@pytest.mark.parametrize("answer", ["Try again", "Leave out"])
def test_a_file_that_is_refused_holds_the_set_back_until_the_operator_answers(
    show: Show, studio: Studio, tmp_path: Path, answer: str
) -> None:
    names = ["neutral", "kiss", "smile"]
    scans = [_scan(tmp_path / f"{name}.obj") for name in names]
    refused = {"status": 413, "code": "quota.bytes", "detail": "no room is left"}
    page = show("/upload", refusals=True)
    begun = 0
    asked: list[list[str]] = []

    def on_upload(route: Any) -> None:
        nonlocal begun
        begun += 1
        if begun == 2:
            route.fulfill(status=413, content_type="application/problem+json", json=refused)
        else:
            route.continue_()

    def on_batch(route: Any) -> None:
        asked.append([scan["name"] for scan in route.request.post_data_json["captures"]])
        route.continue_()

    page.route(re.compile("/v1/uploads$"), on_upload)
    page.route(re.compile("/v1/batches$"), on_batch)
    page.set_input_files("#files", [str(path) for path in scans])
    page.get_by_label("Name of the new subject").fill(f"Mira, {answer}")
    page.get_by_role("button", name="Upload 3 scans").click()
    _row(page, "kiss.obj").get_by_text("No room is left").wait_for()
    _row(page, "smile.obj").locator(".state").get_by_text("Uploaded").wait_for()
    page.wait_for_load_state("networkidle")
    assert asked == []

    _row(page, "kiss.obj").get_by_role("button", name=answer).click()
    expected = [name for name in names if answer == "Try again" or name != "kiss"]
    for name in expected:
        _row(page, f"{name}.obj").locator(".state").get_by_text("Good").wait_for()
    assert asked == [expected]


def test_a_scan_replaces_an_earlier_one_if_the_operator_says_so(
    show: Show, studio: Studio, tmp_path: Path
) -> None:
    subject_id = studio.subject()
    before = studio.raw(subject_id, "kiss", verdict="bad")
    page = show(f"/upload?subject={subject_id}", refusals=True)
    page.set_input_files("#files", str(_scan(tmp_path / "kiss.obj")))
    page.get_by_role("button", name="Upload 1 scan").click()
    page.get_by_role("button", name="Replace the earlier scan").click()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.method))
    path = f"/v1/subjects/{subject_id}/captures"
    assert before in [capture["id"] for capture in studio.get(path)["items"]]
    page.get_by_role("button", name="Replace it").click()
    _row(page, "kiss.obj").locator(".state").get_by_text("Good").wait_for()
    captures = studio.get(path)["items"]
    assert len(captures) == 2
    assert before not in [capture["id"] for capture in captures]
    assert "DELETE" not in asked  # the service replaces it in one step


def test_a_registered_scan_is_counted_before_it_is_sent(
    show: Show, studio: Studio, tmp_path: Path
) -> None:
    page = show("/upload")
    scan = _scan(tmp_path / "neutral.obj", size=MB)
    scan.write_text(scan.read_text() + "vn 0 0 1\n")
    page.set_input_files("#files", str(scan))
    page.get_by_label("Name of the new subject").fill("Otto, counted")
    page.get_by_label("The scans are").select_option("registered")
    page.get_by_role("button", name="Upload 1 scan").click()
    page.get_by_text(f"neutral.obj has {MB // 8} vertices, and a registered scan has").wait_for()
    names = [each["name"] for each in studio.get("/v1/subjects")["items"]]
    assert "Otto, counted" not in names
    # what is no scan has no template's topology
    page.get_by_label("Role of neutral.obj").select_option("asset")
    page.get_by_role("button", name="Upload 1 scan").click()
    _row(page, "neutral.obj").get_by_text("An asset: scenes name it.").wait_for()


def test_a_subject_and_its_scans_are_called_as_the_studio_likes(show: Show, studio: Studio) -> None:
    subject_id = studio.subject()
    capture = studio.raw(subject_id, "smile")
    page = show(f"/subjects/{subject_id}")
    page.get_by_role("button", name="Edit", exact=True).first.click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Name").fill("Ida, Tuesday")
    dialog.get_by_label("Labels").fill("session: 17\nactor")
    dialog.get_by_role("button", name="Save").click()
    dialog.get_by_text('"actor" is no label').wait_for()
    dialog.get_by_label("Labels").fill("session: 17\nactor: Ida")
    dialog.get_by_role("button", name="Save").click()
    page.locator("h1").get_by_text("Ida, Tuesday").wait_for()
    page.get_by_text("session: 17, actor: Ida").wait_for()
    page.get_by_role("button", name="Edit smile").click()
    dialog.get_by_label("Title").fill("Broad smile")
    dialog.get_by_label("Name").fill("grin")
    dialog.get_by_role("button", name="Save").click()
    page.get_by_role("row", name="grin").get_by_text("Broad smile").wait_for()
    found = studio.get(f"/v1/subjects/{subject_id}/captures/{capture}")
    assert (found["name"], found["title"], found["role"]) == ("grin", "Broad smile", "expression")
    assert studio.get(f"/v1/subjects/{subject_id}")["labels"] == {"session": "17", "actor": "Ida"}


def test_an_upload_goes_on_after_a_lost_connection_and_a_reload(
    show: Show, studio: Studio, tmp_path: Path
) -> None:
    scan = _scan(tmp_path / "neutral.obj", size=12 * MB)
    page = show("/upload", refusals=True)
    sent: list[int] = []

    def on_patch(route: Any) -> None:
        if route.request.method != "PATCH":
            route.continue_()
            return
        sent.append(int(route.request.headers["upload-offset"]))
        assert route.request.headers["upload-checksum"].startswith("sha256 ")
        if len(sent) == 1:
            route.continue_()
        else:  # the connection breaks, and stays so
            route.abort()

    page.route("**/v1/uploads/**", on_patch)
    page.set_input_files("#files", str(scan))
    page.get_by_label("Name of the new subject").fill("Jonas")
    page.get_by_role("button", name="Upload 1 scan").click()
    _row(page, "neutral.obj").get_by_text("Trying again").wait_for()
    page.get_by_text(re.compile("No answer since")).wait_for()
    assert sent[:2] == [0, PIECE]

    page.once("dialog", lambda dialog: dialog.accept())  # "leave, though uploads are under way?"
    page.reload()
    page.unroute("**/v1/uploads/**")
    page.get_by_text("Drop the same files again").wait_for()
    assert page.get_by_label("Subject", exact=True).evaluate(
        "select => select.selectedOptions[0].text"
    ) == ("Jonas")
    offsets: list[int] = []
    page.on(
        "request",
        lambda request: (
            request.method == "PATCH" and offsets.append(int(request.headers["upload-offset"]))
        ),
    )
    page.set_input_files("#files", str(scan))
    page.get_by_role("button", name="Upload 1 scan").click()
    _row(page, "neutral.obj").locator(".state").get_by_text("Good").wait_for()
    assert offsets
    assert min(offsets) >= PIECE, "what had arrived is not sent twice"
    assert page.evaluate("localStorage.getItem('myoface.uploads')") is None


def test_an_upload_that_is_just_made_a_file_is_asked_for_again(
    show: Show, studio: Studio, tmp_path: Path
) -> None:
    scan = _scan(tmp_path / "neutral.obj", size=1 * MB)
    page = show("/upload", refusals=True)
    refused = {"status": 409, "code": "upload.offset", "detail": "another offset"}
    unheard = ["PATCH", "HEAD"]  # a piece whose answer was lost, and the question what came of it

    def on_upload(route: Any) -> None:
        if unheard[:1] != [route.request.method]:
            route.continue_()
            return
        body = {"json": refused} if unheard.pop(0) == "PATCH" else {}
        route.fulfill(status=409, content_type="application/problem+json", **body)

    page.route("**/v1/uploads/**", on_upload)
    page.set_input_files("#files", str(scan))
    page.get_by_label("Name of the new subject").fill("Noa")
    page.get_by_role("button", name="Upload 1 scan").click()
    _row(page, "neutral.obj").locator(".state").get_by_text("Good").wait_for()
    assert unheard == []


def test_a_job_is_watched_canceled_and_run_again(show: Show, studio: Studio) -> None:
    subject_id = studio.modelled()
    long = studio.capture(subject_id, "long", seconds="60")
    page = show("/")
    page.locator("tr[data-job]").first.wait_for()
    job_id = studio.submit("fit_geometry", subject_id, captures=[long], options={"rounds": 7})

    row = page.locator(f'tr[data-job="{job_id}"]')  # it comes by itself
    row.get_by_text("Running").wait_for()
    row.get_by_text(re.compile("Geometry, iteration")).wait_for()
    row.get_by_text(re.compile("about .* left")).wait_for()
    page.locator("#announcer").get_by_text(re.compile("Fit the muscle geometry.*Running")).wait_for(
        state="attached"
    )

    row.get_by_role("link", name="Fit the muscle geometry").click()
    page.locator("h1").get_by_text("Fit the muscle geometry").wait_for()
    page.get_by_role("img", name=re.compile(r"^Mean error: from 2\.\d+ to .* mm")).wait_for()
    page.get_by_role("log").get_by_text("objective").first.wait_for()
    assert page.locator("dd strong").inner_text() == "7"
    page.get_by_role("button", name="Cancel").click()
    page.get_by_label("Reason").fill("wrong take")
    page.get_by_role("button", name="Cancel the job").click()
    page.get_by_text(re.compile("wrong take")).wait_for()
    page.locator(".head .state").get_by_text("Canceled").wait_for()
    assert studio.job(job_id)["cancel"]["reason"] == "wrong take"

    page.get_by_role("button", name="Run again").click()
    rounds = page.get_by_role("dialog").get_by_label("Rounds")
    assert rounds.input_value() == "7"
    rounds.fill("3")
    page.get_by_role("dialog").get_by_role("button", name="Run again").click()
    page.wait_for_url(lambda url: "/jobs/" in url and job_id not in url)
    again = studio.job(page.url.rsplit("/", 1)[1])
    assert (again["options"], again["captures"]) == ({"rounds": 3}, [long])
    assert again["parent_id"] == job_id
    studio.post(f"/v1/jobs/{again['id']}/cancel", reason="the test is over")
    page.locator(".head .state").get_by_text("Canceled").wait_for()

    page.go_back()
    page.get_by_text(re.compile("wrong take")).wait_for()


def test_what_is_bad_about_a_take_is_said_as_of_a_take(show: Show, studio: Studio) -> None:
    subject_id = studio.subject()
    take = studio.raw(subject_id, "smile", "markers", verdict="bad")
    job = studio.done("check_markers", subject_id, captures=[take])["id"]
    for path in (f"/jobs/{job}", f"/?subject_id={subject_id}", f"/subjects/{subject_id}"):
        page = show(path)
        page.get_by_text("Bad: it cannot be used").first.wait_for()
        assert page.get_by_text("scan again").count() == 0


def test_a_failure_is_told_in_words_and_lists_are_filtered(show: Show, studio: Studio) -> None:
    subject_id = studio.subject(verdict="usable")
    bad = studio.raw(subject_id, "brows", fault="nan")
    (neutral,) = [
        capture["id"]
        for capture in studio.get(f"/v1/subjects/{subject_id}/captures")["items"]
        if capture["role"] == "neutral"
    ]
    studio.done("check_scan", subject_id, captures=[neutral])
    failed = studio.submit("check_scan", subject_id, captures=[bad])
    studio.finished(failed)

    page = show(f"/?subject_id={subject_id}")
    page.locator("tr[data-job]").nth(1).wait_for()
    assert page.locator("tr[data-job]").count() == 2
    page.get_by_text("Usable").wait_for()
    page.get_by_label("State").select_option("failed")
    page.get_by_text("Usable").wait_for(state="detached")
    assert page.locator("tr[data-job]").count() == 1
    assert "state=failed" in page.url
    page.reload()  # the address says what is shown
    page.locator(f'tr[data-job="{failed}"] a').first.click()
    notice = page.locator(".notice.bad")
    notice.get_by_text("has a NaN in line 3").wait_for()
    assert "scan.nan" in notice.inner_text()


def test_long_lists_come_in_pages(show: Show, studio: Studio) -> None:
    subject_id = studio.modelled()
    long = studio.capture(subject_id, "long", seconds="60")
    for _ in range(54):
        job_id = studio.submit("fit_geometry", subject_id, captures=[long])
        studio.post(f"/v1/jobs/{job_id}/cancel", reason="not needed")
    page = show(f"/?subject_id={subject_id}")
    rows = page.locator("tr[data-job]")
    rows.nth(49).wait_for()
    newest = rows.first.get_attribute("data-job")
    page.get_by_role("button", name="Older").click()
    eventually(lambda: rows.count() == 5)  # with the job that built the model
    assert page.get_by_role("button", name="Older").is_hidden()
    page.get_by_role("button", name="Newer").click()
    eventually(lambda: rows.count() == 50)
    assert rows.first.get_attribute("data-job") == newest


def test_a_table_of_known_activations_is_chosen_for_fits(show: Show, studio: Studio) -> None:
    subject_id, rig_id = studio.rigged()
    emg = studio._add(subject_id, "emg", "activations", {})
    smile = studio.capture(subject_id, "smile-again", registered=True)
    performance = studio._add(subject_id, "talk", "performance", {})
    page = show(f"/subjects/{subject_id}")
    page.get_by_label("Choose emg for a fit").check()
    assert page.get_by_role("button", name="Fit the chosen").is_disabled()
    page.get_by_label("Choose smile-again for a fit").check()
    page.get_by_role("button", name="Fit 1 expression").click()
    page.get_by_role("dialog").get_by_role("button", name="Submit").click()
    page.get_by_role("link", name="Alex").first.click()
    page.get_by_label("Choose emg for a fit").check()
    page.get_by_role("button", name="Fit talk").click()
    page.get_by_role("dialog").get_by_role("button", name="Submit").click()
    page.locator(".head .state").wait_for()
    jobs = studio.get(f"/v1/jobs?subject_id={subject_id}&reads={emg}")["items"]
    read = {job["kind"]: job["captures"] for job in jobs}
    assert read == {"fit_geometry": [emg, smile], "fit_sequence": [performance, emg]}
    assert next(job for job in jobs if job["kind"] == "fit_sequence")["rig_id"] == rig_id


def test_chosen_photographs_are_fitted_with_a_rig(show: Show, studio: Studio) -> None:
    subject_id, rig_id = studio.rigged()
    page = show(f"/subjects/{subject_id}")
    fit = page.get_by_role("button", name="Fit photographs")
    eventually(lambda: fit.get_attribute("title") == "Upload photographs first")
    plate = studio._add(subject_id, "plate", "photo", {})
    page.reload()
    eventually(lambda: fit.get_attribute("title") == "Build tracks first")
    studio.done("build_tracks", subject_id)
    page.reload()
    choose = "Choose photographs in the list of scans first"
    eventually(lambda: fit.get_attribute("title") == choose)
    assert fit.is_disabled()
    page.get_by_label("Choose smile for a fit").check()  # what is fitted elsewhere stays out
    page.get_by_label("Choose plate for a fit").check()
    fit.click()
    page.get_by_role("dialog").get_by_role("button", name="Submit").click()
    picture = page.get_by_role("img", name="Photographs beside the fitted face")
    eventually(lambda: picture.evaluate("image => image.naturalWidth") == 480)
    for name in ("photo.json", "photo.npz"):
        assert page.get_by_role("button", name=f"Download {name}").is_visible()
    job = studio.job(page.url.rsplit("/", 1)[1])
    assert (job["kind"], job["rig_id"], job["captures"]) == ("fit_photo", rig_id, [plate])


def test_a_person_without_a_scan_begins_with_photographs(show: Show, studio: Studio) -> None:
    subject_id = studio.post("/v1/subjects", name="Ada")["id"]
    plate = studio._add(subject_id, "plate", "photo", {})
    page = show(f"/subjects/{subject_id}")
    estimate = page.get_by_role("button", name="Estimate a neutral from photographs")
    choose = "Choose photographs in the list of scans first"
    eventually(lambda: estimate.get_attribute("title") == choose)
    page.get_by_label("Choose plate for a fit").check()
    estimate.click()
    page.get_by_role("dialog").get_by_role("button", name="Submit").click()
    picture = page.get_by_role("img", name="Photographs and the person that they were made into")
    eventually(lambda: picture.evaluate("image => image.naturalWidth") == 480)
    job = studio.job(page.url.rsplit("/", 1)[1])
    assert (job["kind"], job["captures"]) == ("neutral_from_photos", [plate])
    studio.done("build_model", subject_id)
    studio.done("build_tracks", subject_id)
    page = show(f"/subjects/{subject_id}")
    page.get_by_label("Choose plate for a fit").check()
    page.get_by_role("button", name="Fit photographs").click()
    page.get_by_role("dialog").get_by_role("button", name="Submit").click()
    picture = page.get_by_role("img", name="Photographs beside the fitted face")
    eventually(lambda: picture.evaluate("image => image.naturalWidth") == 480)
    job = studio.job(page.url.rsplit("/", 1)[1])
    assert (job["kind"], job["captures"], job["rig_id"]) == ("fit_photo", [plate], None)
    # the rig that it made is what photographs are fitted with next
    page = show(f"/subjects/{subject_id}")
    eventually(lambda: page.get_by_role("button", name="Fit photographs").count() == 1)


def test_a_film_is_fitted_and_leaves_a_sequence(show: Show, studio: Studio) -> None:
    subject_id, rig_id = studio.rigged()
    studio.done("build_tracks", subject_id)
    film = studio._add(subject_id, "clip", "film", {"frames": 4})
    page = show(f"/subjects/{subject_id}")
    page.get_by_role("row", name="clip").get_by_role("button", name="Fit").click()
    dialog = page.get_by_role("dialog")
    assert dialog.get_by_role("checkbox", name="sequence").is_checked()
    dialog.get_by_role("button", name="Submit").click()
    play = page.get_by_role("link", name="Play it on the rig")
    eventually(play.is_visible)
    job = studio.job(page.url.rsplit("/", 1)[1])
    assert (job["kind"], job["captures"], job["rig_id"]) == ("fit_photo", [film], rig_id)
    # it leaves frames, and no rig
    assert job["result"]["rig_id"] is None
    assert len(studio.get(f"/v1/jobs/{job['id']}/frames")["frames"]) == 4
    page.get_by_role("button", name="Play it in a scene").click()
    page.get_by_role("dialog").get_by_text("Simulate a scene").wait_for()


def test_a_subject_is_worked_with_and_deleted(show: Show, studio: Studio) -> None:
    subject_id = studio.modelled()
    studio.capture(subject_id, "smile")
    page = show("/subjects")
    page.get_by_role("link", name="Alex").first.click()
    page.get_by_label("Choose smile for a fit").check()
    page.get_by_role("button", name="Fit 1 expression").click()
    page.get_by_role("dialog").get_by_role("button", name="Submit").click()
    page.get_by_role("link", name="Open the rig").wait_for()
    with page.expect_download() as download:
        page.get_by_role("button", name="Download rig.glb").click()
    assert Path(download.value.path()).read_bytes().startswith(b"glTF")

    page.goto(f"{studio.http.base_url}".rstrip("/") + f"/subjects/{subject_id}")
    page.get_by_role("link", name="Open the rig").wait_for()
    assert page.get_by_text("Shoot next").is_hidden()
    page.get_by_role("button", name=re.compile("next scan", re.IGNORECASE)).click()
    page.get_by_role("dialog").get_by_role("button", name="Submit").click()
    page.locator(".head .state").get_by_text("Succeeded").wait_for()
    page.get_by_role("link", name="Alex").first.click()
    page.get_by_text("Shoot next: not smile. Why").wait_for()
    page.get_by_role("button", name="Delete subject").click()
    page.get_by_label(re.compile("type the name")).fill("Alex")
    page.get_by_role("button", name="Delete for good").click()
    page.get_by_text("Alex is deleted").wait_for()
    assert studio.http.get(f"/v1/subjects/{subject_id}").status_code == 404


def test_from_a_dropped_scan_set_to_the_rig_and_a_comparison(
    show: Show, studio: Studio, tmp_path: Path
) -> None:
    folder = tmp_path / "session"
    folder.mkdir()
    _scan(folder / "neutral.obj")
    _scan(folder / "smile.obj", seconds="4", view="yes")
    page = show("/upload")
    _drop(page, [folder])
    page.get_by_label("Name of the new subject").fill("Mei, Tuesday")
    page.get_by_label("The scans are").select_option("registered")
    page.get_by_role("button", name="Upload 2 scans").click()
    for name in ("neutral", "smile"):
        _row(page, f"{name}.obj").locator(".state").get_by_text("Good").wait_for()

    page.get_by_role("link", name="Go to the subject").click()
    page.get_by_role("button", name="Build the model").click()
    page.get_by_role("dialog").get_by_role("button", name="Submit").click()
    page.locator(".head .state").get_by_text("Succeeded").wait_for()
    rigs = []
    for _ in range(2):
        page.get_by_role("link", name="Mei, Tuesday").click()
        page.get_by_label("Choose smile for a fit").check()
        page.get_by_role("button", name="Fit 1 expression").click()
        page.get_by_role("dialog").get_by_role("button", name="Submit").click()
        page.get_by_role("progressbar", name="Progress").wait_for()
        page.get_by_role("link", name="Open the rig").click(timeout=SAMPLE_MS)
        page.locator("canvas.stage").wait_for()
        rigs.append(page.url.rsplit("/", 1)[1])

    smile = page.get_by_role("slider", name="Smile")
    smile.fill("0.5")
    page.get_by_label("Heat map").select_option("distance")
    page.locator(".heat-legend").wait_for()
    page.wait_for_url(lambda url: "e=smile:0.5" in url and "heat=" in url)
    page.get_by_role("tab", name="Muscles").click()
    page.get_by_text(re.compile("approximation: mean .* mm")).wait_for()
    page.goto(f"{studio.http.base_url}".rstrip("/") + f"/compare?a={rigs[0]}&b={rigs[1]}")
    page.locator("canvas.stage").wait_for()


def test_a_key_is_asked_for_taken_from_the_address_and_forgotten(
    show: Show, studio: Studio
) -> None:
    page = show("/health", key=None, refusals=True)
    page.get_by_label("API key").fill("myo_nonsense")
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("not one of this service's").wait_for()
    page.get_by_label("API key").fill(studio.key)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_text("All parts answer").wait_for()
    assert page.url.endswith("/health")

    page = show("/health")
    page.get_by_text("All parts answer").wait_for()
    page.get_by_role("row", name="Lost or damaged files none").wait_for()
    assert studio.key not in page.url
    page.get_by_role("link", name="Signed in").click()
    page.get_by_role("button", name="Make a key").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("For whom").fill("station 2")
    dialog.get_by_role("button", name="Make it").click()
    made = page.get_by_role("textbox", name="The key station 2").input_value()
    page.get_by_role("button", name="I have it").click()
    assert studio.http.get("/v1/me", headers={"Authorization": f"Bearer {made}"}).json()[
        "scopes"
    ] == ["read", "write"]
    page.get_by_role("button", name="Revoke station 2").click()
    page.get_by_role("dialog").get_by_role("button", name="Revoke").click()
    page.get_by_text("Revoked").wait_for()
    page.get_by_role("button", name="Sign out").click()
    assert page.evaluate("sessionStorage.length") == 0


def test_it_is_used_by_keyboard_and_its_colours_are_chosen(show: Show) -> None:
    page = show("/health")
    page.get_by_text("All parts answer").wait_for()
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"
    ground = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(ground)
    page.get_by_label("Colours").select_option("dark")
    dark = page.evaluate(ground)
    assert light != dark
    page.reload()
    assert page.evaluate(ground) == dark
    page.get_by_role("link", name="Queue").press("Enter")
    page.locator("h1:focus").wait_for()
    assert page.title() == "Queue · Myoface"
