"""What became of the jobs, and whether that is what should have."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table
from sqlalchemy import select

from myoface.backup import back_up, verify
from service.queue.states import FINAL, State
from service.store import deletion
from service.store.models import Attempt, Event, Job, Rig
from tests.campaigns.chaos.stage import Stage
from worker.orphans import ATTEMPT

PATIENCE = 180.0
STILL = 30.0
"""Seconds within which a live face follows again, whatever was struck."""
PROMPT = 5.0
"""Seconds within which a submission or a look is answered, whatever is wrong."""


class Tally:
    """Counts the blows, then checks how the jobs ended."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._blows: Counter[str] = Counter()
        self._missed: Counter[str] = Counter()
        self._states: Counter[str] = Counter()
        self._outcomes: Counter[str] = Counter()
        self._checks: list[tuple[str, object, bool]] = []
        self._ends: list[tuple[float, str]] = []  # of blows, by the monotonic clock

    @property
    def is_fine(self) -> bool:
        """Whether everything was as it should be."""
        return all(fine for _, _, fine in self._checks)

    def struck(self, blow: str, hit: bool) -> None:
        """Count a blow."""
        (self._blows if hit else self._missed)[blow] += 1
        self._ends.append((time.monotonic(), blow))

    def settle(self, stage: Stage) -> None:
        """Wait for the jobs and check what is left of them."""
        stage.until(stage.are_over, PATIENCE)
        self._of_the_station(stage)
        jobs = stage.jobs()
        self._states = Counter(job.state.value for job in jobs)
        good = [job for job in jobs if job.id in stage.good]
        poison = [job for job in jobs if job.id in stage.poison]
        self._all("jobs that are over", [job.state in FINAL for job in jobs])
        self._all("good jobs that succeeded", [job.state is State.SUCCEEDED for job in good])
        self._of_the_tables(stage, jobs)
        self._all("poison failed as worker_lost after 3 tries", list(map(_is_given_up, poison)))
        spoilt = [job for job in jobs if job.id in stage.spoilt]
        self._all("jobs of damaged and lost files that failed so", list(map(_is_told, spoilt)))
        self._of_the_files(stage)
        if "kill-backup" in self._blows:
            self._of_the_backup(stage)
        work = stage.stack.settings.work
        self._none("folders of attempts left", lambda: _attempts(work), stage)
        self._none("solver processes left", lambda: len(stage.studio.solvers(stage.stack)), stage)
        self._of_the_answers(stage)
        missed = [blow for blow in self._missed if not self._blows[blow]]
        for blow, reason in stage.left_out.items():
            missed.remove(blow)
            self._check(blow, f"left out: {reason}", fine=True)
        self._check("kinds of blow that hit nothing", ", ".join(missed) or 0, not missed)

    def show(self, store: str, seconds: float) -> None:
        """Print the tally."""
        console = Console(width=100)
        title = f"{store}, seed {self._seed}, {seconds:.0f} s"
        blows = Table("blow", "hit", "missed", title=title)
        for name in sorted(self._blows | self._missed):
            blows.add_row(name, str(self._blows[name]), str(self._missed[name]))
        console.print(blows)
        ends = Table("jobs", "n", "attempts", "n ", title="how they ended")
        left = sorted(self._states.items())
        right = sorted(self._outcomes.items())
        for number in range(max(len(left), len(right))):
            state = _at(left, number)
            outcome = _at(right, number)
            ends.add_row(*state, *outcome)
        console.print(ends)
        checks = Table("check", "found", "", title="checks")
        for check, found, fine in self._checks:
            checks.add_row(check, str(found), "ok" if fine else "[bold red]WRONG")
        console.print(checks)

    def _of_the_tables(self, stage: Stage, jobs: list[Job]) -> None:
        with stage.store.read() as session:
            attempts = session.scalars(select(Attempt)).all()
            states = session.scalars(select(Event).where(Event.kind == "state")).all()
            rigs = Counter(session.scalars(select(Rig.job_id)))
        counted = {job.id for job in jobs}
        self._outcomes = Counter(str(one.outcome) for one in attempts if one.job_id in counted)
        ends = Counter(one.job_id for one in states if State(one.data["state"]) in FINAL)
        done = Counter(one.job_id for one in attempts if one.outcome == "succeeded")
        succeeded = [job for job in jobs if job.state is State.SUCCEEDED]
        self._all("jobs that ended exactly once", [ends[job.id] == 1 for job in jobs])
        self._all("successes by exactly one attempt", [done[job.id] == 1 for job in succeeded])
        self._all(
            "fits that left exactly one rig, other jobs none",
            [rigs[job.id] == (job.kind == "fit_geometry") for job in succeeded],
        )
        stuck = [job for job in jobs if job.lease_owner or job.lease_until]
        unclosed = [one for one in attempts if one.outcome is None]
        left_open = len(stuck) + len(unclosed)
        self._check("leases and attempts left open", left_open, not left_open)

    def _of_the_station(self, stage: Stage) -> None:
        """End the live session, and judge how it went."""
        station = stage.station
        station.close()
        with stage.store.read() as session:
            job = session.get(Job, station.session)
            states = session.scalars(
                select(Event).where(Event.kind == "state", Event.job_id == station.session)
            )
            ends = sum(State(each.data["state"]) in FINAL for each in states)
        assert job is not None, "the session was opened before anything was struck"
        found = f"{job.state.value}, ended {ends} times, lost {job.lost} times"
        fine = job.state is State.SUCCEEDED and ends == 1 and not job.lease_owner
        self._check("the live session", found, fine)
        during = self._during(station.since, station.longest_s)
        told = f"{station.longest_s:.1f} of {station.followed} faces, {during}"
        fine = station.longest_s < STILL and station.error is None
        self._check("a live face stood still, s", f"{told} {station.error or ''}".strip(), fine)

    def _during(self, since: float, seconds: float) -> str:
        """Return the blows that ended within so long since a moment, and the one under way then."""
        after = [(moment, blow) for moment, blow in self._ends if moment >= since]
        count = sum(moment <= since + seconds for moment, _ in after)
        return ", ".join(blow for _, blow in after[: count + 1]) or "after all blows"

    def _of_the_files(self, stage: Stage) -> None:
        """Compare the stored files with the rows that refer to files."""
        # a file is put aside first and removed by the next round
        collected = sum(deletion.collect_garbage(stage.store, 0) for _ in range(2))
        wanted = deletion.referenced_files(stage.store) - stage.gone
        there = {stored.sha256 for stored in stage.store.files.list_stored()} - stage.gone
        self._check("files of lost attempts collected", collected, fine=True)
        self._check("orphan files", len(there - wanted), there <= wanted)
        self._check("files missing", len(wanted - there), wanted <= there)

    def _of_the_backup(self, stage: Stage) -> None:
        """Make a last backup, and compare what it holds with the rows."""
        back_up(stage.stack.settings, stage.backup)
        manifest, _ = verify(stage.backup)
        wanted = deletion.referenced_files(stage.store) - stage.gone
        self._check(
            "files that a restore lacks",
            len(wanted - {*manifest.files}),
            fine=wanted <= {*manifest.files},
        )

    def _of_the_answers(self, stage: Stage) -> None:
        """Judge how requests were answered meanwhile."""
        slowest = stage.slowest_submission
        reader = stage.reader
        self._check("slowest submission, s", f"{slowest:.2f}", slowest < PROMPT)
        failed = f"{len(reader.refused)} of {len(reader.waits)} {'; '.join(reader.refused[:2])}"
        self._check("reads that failed", failed.strip(), not reader.refused)
        self._check("slowest read, s", f"{max(reader.waits):.2f}", max(reader.waits) < PROMPT)

    def _all(self, check: str, fulfilled: list[bool]) -> None:
        self._check(check, f"{sum(fulfilled)} of {len(fulfilled)}", all(fulfilled))

    def _none(self, check: str, count: Callable[[], int], stage: Stage) -> None:
        fine = stage.until(lambda: not count())
        self._check(check, count(), fine)

    def _check(self, check: str, found: object, fine: bool) -> None:
        self._checks.append((check, found, fine))


def _is_given_up(job: Job) -> bool:
    code = (job.error or {}).get("code")
    return job.state is State.FAILED and code == "worker_lost" and job.lost == 3


def _attempts(work: Path) -> int:
    """Count the folders of attempts; caches stay."""
    return sum(bool(ATTEMPT.fullmatch(path.name)) for path in work.iterdir())


def _is_told(job: Job) -> bool:
    """Whether a job failed for a file that is not whole, and none of its tries was lost to that."""
    return job.state is State.FAILED and (job.error or {}).get("code") == "files.lost"


def _at(rows: list[tuple[str, int]], number: int) -> tuple[str, str]:
    return (rows[number][0], str(rows[number][1])) if number < len(rows) else ("", "")
