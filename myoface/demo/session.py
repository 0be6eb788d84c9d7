"""A session at a capture station: scans up, model and rig built by the service, files down."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from myoface.cli.console import JobView, err, transfer_bar
from myoface.client import Client
from myoface.errors import ApiError
from myoface.resources import Artifact, Job, Kind, Role
from solver.anatomy.capture_set import CaptureSet

LOG_TAIL = 20


@dataclass
class Session:
    """One person's way through the service; ``seconds`` collects the time of each phase."""

    client: Client
    folder: Path
    seconds: dict[str, float] = field(default_factory=dict)

    def run(
        self, name: str, captures: CaptureSet, template: Path | None, model_options: dict[str, Any]
    ) -> dict[str, Any]:
        """Upload the scans, build the model, fit training and unseen scans, download everything.

        Returns the rig's ``report.json``; the files are in ``folder``. Raises :class:`ApiError`.
        """
        template_id = None
        with self.timed("upload"):
            if template is not None:
                with transfer_bar(template.name) as progress:
                    made = self.client.create_template(template.stem, template, progress=progress)
                template_id = made.id
            subject = self.client.create_subject(name, template_id=template_id)
            ids = self._upload(subject.id, captures)

        model = self._solve("build_model", subject.id, options=model_options)
        geometry = self._solve(
            "fit_geometry", subject.id, captures=[ids[n] for n in captures.train]
        )
        unseen = [ids[n] for n in captures.test]
        rig = self._solve("fit_activations", subject.id, captures=unseen, rig_id=_rig_id(geometry))

        with self.timed("download"):
            # Later files take the place of earlier ones of the same name: the last rig is whole.
            files = {each.name: each for job in (model, geometry, rig) for each in _files(job)}
            self._download(files.values())
        report: dict[str, Any] = json.loads((self.folder / "report.json").read_text())
        return report

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Count the time of a block as ``phase``."""
        begun = time.monotonic()
        yield
        self.seconds[phase] = time.monotonic() - begun

    def _upload(self, subject_id: str, captures: CaptureSet) -> dict[str, str]:
        ids = {}
        for name, path in captures.write(self.folder / "scans").items():
            role: Role = "neutral" if name == "neutral" else "expression"
            with transfer_bar(path.name) as progress:
                capture = self.client.add_capture(subject_id, path, role=role, progress=progress)
            ids[name] = capture.id
        return ids

    def _solve(self, kind: Kind, subject_id: str, **request: Any) -> Job:
        job = self.client.submit(kind, subject_id, **request)
        try:
            with JobView(kind) as view:
                ended = self.client.wait(job.id, view.watch)
        except ApiError:
            for line in list(self.client.log(job.id))[-LOG_TAIL:]:
                err.print(f"  {line.text}", markup=False)
            raise
        self.seconds |= {f"{kind}: {phase}": spent for phase, spent in view.phases.items()}
        return ended

    def _download(self, artifacts: Iterable[Artifact]) -> None:
        for artifact in artifacts:
            with transfer_bar(artifact.name) as progress:
                self.client.download(artifact, self.folder / artifact.name, progress=progress)


def _files(job: Job) -> list[Artifact]:
    return job.result.artifacts if job.result is not None else []


def _rig_id(job: Job) -> str | None:
    return job.result.rig_id if job.result is not None else None
