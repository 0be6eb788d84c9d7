"""The states of a job and the steps allowed between them: one table for API, worker and docs."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """State of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    CANCELING = "canceling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELED = "canceled"


ALLOWED: dict[State, frozenset[State]] = {
    State.QUEUED: frozenset({State.RUNNING, State.CANCELED}),
    State.RUNNING: frozenset({State.SUCCEEDED, State.FAILED, State.CANCELING, State.QUEUED}),
    State.CANCELING: frozenset({State.CANCELED}),
    State.SUCCEEDED: frozenset(),
    State.FAILED: frozenset(),
    State.CANCELED: frozenset(),
}

FINAL = frozenset(state for state, following in ALLOWED.items() if not following)
# States in which a worker holds the job's lease
HELD = frozenset({State.RUNNING, State.CANCELING})


def before(state: State) -> list[State]:
    """Return the states from which ``state`` may be entered."""
    return [origin for origin, following in ALLOWED.items() if state in following]
