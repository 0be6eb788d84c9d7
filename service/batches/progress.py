"""Where a batch is: what its jobs say about each scan and each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from service.store.models import Batch, Capture, Job
from service.store.transitions import FINAL, State

CHECK, REGISTER, MODEL, FIT = "check_scan", "register_scan", "build_model", "fit_geometry"


class Stand(Enum):
    """What can be made of a scan."""

    WAITING = "waiting"
    TO_REGISTER = "to register"
    READY = "ready"
    OUT = "out"


@dataclass(frozen=True)
class Progress:
    """A batch's scans, in the order given, and the newest job of each kind and scan."""

    batch: Batch
    scans: list[Capture]
    _jobs: dict[tuple[str, str | None], Job] = field(repr=False)

    @classmethod
    def of(cls, batch: Batch, captures: Mapping[str, Capture], jobs: Sequence[Job]) -> Progress:
        """Sort a batch's rows; ``captures`` by id, ``jobs`` the oldest first."""
        scans = [captures[one] for one in batch.capture_ids if one in captures]
        return cls(batch, scans, {(job.kind, job.capture_id): job for job in jobs})

    @property
    def neutral(self) -> Capture | None:
        """The neutral, if it is among the batch's scans."""
        return next((scan for scan in self.scans if scan.role == "neutral"), None)

    @property
    def expressions(self) -> list[Capture]:
        """The expressions among the scans."""
        return [scan for scan in self.scans if scan.role == "expression"]

    def job(self, kind: str, capture_id: str | None = None) -> Job | None:
        """Return the job of a kind, about a scan if it is about one."""
        return self._jobs.get((kind, capture_id))

    def stand(self, scan: Capture) -> tuple[Stand, str | None]:
        """Return what can be made of a scan; if nothing, why."""
        check = self.job(CHECK, scan.id)
        if check is None:
            return Stand.READY, None
        if check.state not in FINAL:
            return Stand.WAITING, None
        if check.state is not State.SUCCEEDED:
            return Stand.OUT, f"its check {_ended(check)}"
        assert check.summary is not None, "a check leaves its verdict"
        if check.summary["verdict"] == "bad":
            return Stand.OUT, "its check says that it can not be used: scan again"
        if scan.registered or "register" not in self.batch.steps:
            return Stand.READY, None
        registration = self.job(REGISTER, scan.id)
        if registration is None:
            return Stand.TO_REGISTER, None
        if registration.state not in FINAL:
            return Stand.WAITING, None
        if registration.state is not State.SUCCEEDED:
            return Stand.OUT, f"its registration {_ended(registration)}"
        return Stand.READY, None


def failure(job: Job) -> dict[str, str]:
    """Return the error of a batch that can not go on without a job."""
    return {
        "code": "batch.job_failed",
        "message": f"{job.kind} {_ended(job)}",
        "job_id": job.id,
    }


def _ended(job: Job) -> str:
    if job.state is State.CANCELED or job.error is None:
        return "was canceled"
    return f"failed: {job.error['message']}"
