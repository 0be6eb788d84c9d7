"""URLs that open without a key: one file, for a while."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from pydantic import ValidationError

from service.settings import Settings
from service.store.models import Artifact
from tests.service_client import Studio, served

FACE = b"a face, in bytes"


def _artifact(studio: Studio, folder: Path) -> str:
    (folder / "face").write_bytes(FACE)
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    sha256 = store.files.put(folder / "face").sha256
    job = studio.submit("build_model", studio.subject())
    studio.pretend(job, {"rig.glb": sha256})
    artifact: str = studio.job(job)["result"]["artifacts"][0]["id"]
    with store.write() as session:
        session.get_one(Artifact, artifact).size = len(FACE)
    return artifact


def test_a_signed_url_reads_one_file_for_a_while(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path, signed_url_seconds=2)) as studio:
        artifact = _artifact(studio, tmp_path)
        other = _artifact(studio, tmp_path)
        signed = studio.post(f"/v1/artifacts/{artifact}/url")
        url = signed["url"]
        del studio.http.headers["Authorization"]
        whole = studio.http.get(url)
        assert (whole.status_code, whole.content) == (200, FACE)
        assert whole.headers["Cache-Control"] == "private, no-cache"
        part = studio.http.get(url, headers={"Range": "bytes=2-5"})
        assert (part.status_code, part.content) == (206, FACE[2:6])
        asked = studio.http.head(url)
        assert (asked.status_code, asked.headers["Content-Length"]) == (200, str(len(FACE)))
        same = studio.http.get(url, headers={"If-None-Match": whole.headers["ETag"]})
        assert same.status_code == 304

        _, _, token = url.partition("?signed=")
        tenant, until, signature = token.split(".")
        later = f"{tenant}.{int(until) + 60}.{signature}"
        stolen = f"another.{until}.{signature}"
        for path, text in ((artifact, later), (artifact, stolen), (artifact, "x"), (other, token)):
            refused = studio.http.get(f"/v1/artifacts/{path}?signed={text}")
            assert (refused.status_code, refused.json()["code"]) == (403, "url.invalid")
        elsewhere = studio.http.get(f"/v1/subjects?signed={token}")
        assert elsewhere.status_code == 401
        time.sleep(max(0.0, int(until) - time.time()) + 0.1)
        over = studio.http.get(url)
        assert (over.status_code, over.json()["code"]) == (403, "url.expired")


VIEWER = "https://review.studio.example"
ALLOWED = "Access-Control-Allow-Origin"


def test_a_viewer_on_another_site_reads_signed_urls_and_nothing_else(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, viewer_origins=[VIEWER])
    with served(settings) as studio:
        artifact = _artifact(studio, tmp_path)
        url = studio.post(f"/v1/artifacts/{artifact}/url")["url"]
        asks = {"Origin": VIEWER, "Access-Control-Request-Method": "GET"}
        preflight = studio.http.options(url, headers=asks)
        assert (preflight.status_code, preflight.headers[ALLOWED]) == (204, VIEWER)
        assert "Range" in preflight.headers["Access-Control-Allow-Headers"]
        part = studio.http.get(url, headers={"Origin": VIEWER, "Range": "bytes=2-5"})
        assert (part.status_code, part.headers[ALLOWED], part.headers["Vary"]) == (
            206,
            VIEWER,
            "Origin",
        )
        assert "ETag" in part.headers["Access-Control-Expose-Headers"]
        refused = studio.http.get(f"{url}x", headers={"Origin": VIEWER})
        assert (refused.json()["code"], refused.headers[ALLOWED]) == ("url.invalid", VIEWER)

        token = url.partition("?")[2]
        for origin, path in (
            ("https://other.example", url),
            ("null", url),
            (VIEWER, f"/v1/artifacts/{artifact}"),  # by the key
            (VIEWER, f"/v1/subjects?{token}"),
        ):
            answer = studio.http.get(path, headers={"Origin": origin})
            assert (answer.status_code, ALLOWED in answer.headers) == (200, False), (origin, path)
        for headers, path in (
            (asks, "/v1/subjects"),
            (asks | {"Origin": "https://other.example"}, url),
            (asks | {"Access-Control-Request-Method": "DELETE"}, url),
        ):
            answer = studio.http.options(path, headers=headers)
            assert (answer.status_code, ALLOWED in answer.headers) == (405, False)


def test_no_other_site_reads_signed_urls_unless_the_operator_names_it(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        url = studio.post(f"/v1/artifacts/{_artifact(studio, tmp_path)}/url")["url"]
        assert ALLOWED not in studio.http.get(url, headers={"Origin": VIEWER}).headers


@pytest.mark.parametrize("origin", ["review.studio", "https://a.example/", "https://u@a.example"])
def test_a_site_is_named_as_browsers_do(origin: str, tmp_path: Path) -> None:
    with pytest.raises(ValidationError):
        Settings(data_dir=tmp_path, viewer_origins=[origin])


def test_who_signed_is_written_down(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        artifact = _artifact(studio, tmp_path)
        url = studio.post(f"/v1/artifacts/{artifact}/url")["url"]
        entry = studio.get(f"/v1/audit?object_id={artifact}")["items"][0]
        assert entry["action"] == "artifact.signed"
        subject = studio.get("/v1/subjects")["items"][0]["id"]
        assert studio.http.delete(f"/v1/subjects/{subject}").status_code == 204
        del studio.http.headers["Authorization"]
        assert studio.http.get(url).status_code == 404  # deleted for everybody
