"""A session at a capture station: scans up, model and rig built by the service, files down."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from myoface.cli.console import JobDisplay, err, transfer_bar
from myoface.client import Client
from myoface.client.archive import RIG_NOTE
from myoface.errors import ApiError
from myoface.resources import Job, Result
from myoface.roles import Role
from solver.templates.tables import CaptureSet

LOG_TAIL = 20
WORTH_TELLING_S = 0.05

# Options per kind of job; those that are not given are the solver's own.
Options = Mapping[str, dict[str, Any]]


@dataclass
class Session:
    """One person's way through the service.

    ``seconds`` collects the time of each phase; ``rig_id`` is the whole rig's once it has run.
    """

    client: Client
    folder: Path
    seconds: dict[str, float] = field(default_factory=dict)
    rig_id: str | None = None

    def run(
        self, name: str, captures: CaptureSet, template: Path | None, options: Options
    ) -> dict[str, Any]:
        """Upload the scans, build the model, fit training and unseen scans, download everything.

        Unseen scans are fitted by muscles and by muscle tracks, so that the report has both beside
        each other. The rig's sliders are ordered at the end: the service makes them while it runs.

        Returns the rig's ``report.json``; the files are in ``folder``. Raises :class:`ApiError`.
        """
        template_id = None
        with self.time_phase("upload"):
            if template is not None:
                with transfer_bar(template.name) as progress:
                    made = self.client.create_template(template.stem, template, progress=progress)
                template_id = made.id
            subject = self.client.create_subject(name, template_id=template_id)
            ids = self._upload(subject.id, captures)

        def solve(kind: str, asked: Mapping[str, Any] | None = None, **inputs: Any) -> Job:
            chosen = {**(asked or {}), **options.get(kind, {})}
            return self._solve(kind, subject.id, options=chosen, **inputs)

        solve("build_model")
        fit = solve("fit_geometry", captures=[ids[each] for each in captures.train])
        if captures.test:
            solve("build_tracks")
            unseen = [ids[each] for each in captures.test]
            on = {"captures": unseen, "rig_id": _result(fit).rig_id}
            fit = solve("fit_tracks", {"muscles": True}, **on)
        self.rig_id = _result(fit).rig_id
        with self.time_phase("download"), transfer_bar("rig") as progress:
            assert self.rig_id is not None, "a fit leaves a rig"
            # A demonstration takes the place of the one before
            (self.folder / RIG_NOTE).unlink(missing_ok=True)
            self.client.download_rig(self.rig_id, self.folder, progress=progress)
        # Nobody waits for them: they are on their way when the page is opened
        self.client.submit("build_preview", subject.id, rig_id=self.rig_id)
        report: dict[str, Any] = json.loads((self.folder / "report.json").read_text())
        return report

    @contextmanager
    def time_phase(self, phase: str) -> Iterator[None]:
        """Count the time of a block as ``phase``."""
        begun = time.monotonic()
        yield
        self.seconds[phase] = time.monotonic() - begun

    def _upload(self, subject_id: str, captures: CaptureSet) -> dict[str, str]:
        ids = {}
        for name, path in captures.write(self.folder / "scans").items():
            role: Role = "neutral" if name == "neutral" else "expression"
            with transfer_bar(path.name) as progress:
                capture = self.client.add_capture(
                    subject_id, path, role=role, registered=True, progress=progress
                )
            ids[name] = capture.id
        return ids

    def _solve(self, kind: str, subject_id: str, **request: Any) -> Job:
        job = self.client.submit(kind, subject_id, **request)
        try:
            with JobDisplay(kind) as view:
                ended = self.client.wait(job.id, view.watch)
        except ApiError:
            for line in list(self.client.log(job.id))[-LOG_TAIL:]:
                err.print(f"  {line.text}")
            raise
        for phase, spent in view.phases.items():
            if spent >= WORTH_TELLING_S:
                self.seconds[f"{kind}: {phase}"] = spent
        return ended


def _result(job: Job) -> Result:
    assert job.result is not None, "a job that succeeded has a result"
    return job.result
