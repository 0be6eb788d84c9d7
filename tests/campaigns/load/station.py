"""A capture station: uploads a scan, orders its check, and looks at everything twice a second."""

from __future__ import annotations

import base64
import hashlib
import threading
import time
from typing import Any

import httpx

from tests.campaigns.load.measure import Answers

CHUNK = 4 << 20
LOOK_EVERY = 0.5
SCAN_EVERY = 10.0
LOOKS = ("/v1/jobs?limit=50", "/v1/subjects", "/v1/rigs", "/readyz")
"""What a page asks for: its queue shows 50 jobs."""
TIMEOUT = 30.0


class Station(threading.Thread):
    """Works until ``stop`` is set; its uploads and its looks are two connections, as in a browser.

    ``content`` is the scan, which each upload changes by a comment, so that none is stored already.
    """

    def __init__(
        self,
        number: int,
        url: str,
        key: str,
        content: bytes,
        answers: Answers,
        stop: threading.Event,
    ) -> None:
        super().__init__(name=f"station {number}", daemon=True)
        self.uploads = 0
        self._number = number
        self._content = content
        self._answers = answers
        self._stop_asked = stop
        headers = {"Authorization": f"Bearer {key}"}
        self._http = httpx.Client(base_url=url, headers=headers, timeout=TIMEOUT, trust_env=False)

    def run(self) -> None:
        """Upload, look, upload the next."""
        watcher = threading.Thread(target=self._watch, daemon=True)
        with self._http:
            subject = self._post("/v1/subjects", json={"name": f"station {self._number}"})
            watcher.start()
            self._stop_asked.wait(self._number)  # stations do not press the button together
            while not self._stop_asked.is_set() and subject is not None:
                begun = time.monotonic()
                self._scan(subject["id"])
                self._stop_asked.wait(max(SCAN_EVERY - (time.monotonic() - begun), 0))
            watcher.join()

    def _scan(self, subject_id: str) -> None:
        name = f"take{self.uploads}"
        content = self._content + f"# station {self._number} {name}\n".encode()
        upload_id = self._upload(f"{name}.obj", content)
        if upload_id is None:
            return
        body = {"name": name, "role": "expression", "upload_id": upload_id, "registered": False}
        capture = self._post(f"/v1/subjects/{subject_id}/captures", json=body, kind="captures")
        if capture is None:
            return
        order = {"kind": "check_scan", "subject_id": subject_id, "captures": [capture["id"]]}
        self._post("/v1/jobs", json=order)
        self.uploads += 1

    def _upload(self, filename: str, content: bytes) -> str | None:
        sha256 = hashlib.sha256(content).hexdigest()
        metadata = ",".join(
            f"{key} {base64.b64encode(value.encode()).decode()}"
            for key, value in (("filename", filename), ("sha256", sha256))
        )
        headers = {"Upload-Length": str(len(content)), "Upload-Metadata": metadata}
        made = self._post("/v1/uploads", headers=headers)
        if made is None:
            return None
        for offset in range(0, len(content), CHUNK):
            last = offset + CHUNK >= len(content)
            with self._answers.asking(f"PATCH /v1/uploads/{{id}}{' (last)' if last else ''}"):
                self._http.patch(
                    f"/v1/uploads/{made['id']}",
                    content=content[offset : offset + CHUNK],
                    headers={
                        "Upload-Offset": str(offset),
                        "Content-Type": "application/offset+octet-stream",
                    },
                ).raise_for_status()
        return str(made["id"])

    def _watch(self) -> None:
        """Look as a page does: the queue, the people, the service's health."""
        with httpx.Client(
            base_url=self._http.base_url,
            headers=self._http.headers,
            timeout=TIMEOUT,
            trust_env=False,
        ) as http:
            while not self._stop_asked.is_set():
                begun = time.monotonic()
                for path in LOOKS:
                    with self._answers.asking(f"GET {path.partition('?')[0]}"):
                        http.get(path).raise_for_status()
                self._stop_asked.wait(max(LOOK_EVERY - (time.monotonic() - begun), 0))

    def _post(self, path: str, kind: str | None = None, **request: Any) -> Any:
        route = "/v1/subjects/{id}/captures" if kind else path
        with self._answers.asking(f"POST {route}"):
            return self._http.post(path, **request).raise_for_status().json()
        return None
