"""The clock, set ahead and back again while jobs run."""

from __future__ import annotations

import signal
import time

from tests.campaigns.chaos.blows.workers import send_signal
from tests.campaigns.chaos.stage import SETTINGS, Stage

LEASE = SETTINGS["lease"]
LEAST = 60.0  # s
MOST = 600.0  # s; S3 refuses who is a quarter of an hour off


def set_clock(stage: Stage) -> bool:
    """Set the clock ahead, kill a worker that took a job by it, and set it back.

    Ahead all leases are over at once; back again that of the dead worker ends minutes from now.
    """
    clock = stage.places.clock
    if clock is None:
        return stage.leave_out("set-clock", "there is no C compiler here")
    if not stage.nobody_is_on_the_last_try():
        return False
    try:
        clock.set(stage.dice.uniform(LEAST, MOST))
        time.sleep(LEASE)
        stage.submit(len(stage.good) + 3)
        job = stage.target()  # when nobody is on the last try again
        if job is None or job.lease_owner is None:
            return False
        hit = send_signal(job.lease_owner, signal.SIGKILL)
        clock.set(stage.dice.choice([0.0, -stage.dice.uniform(LEAST, MOST)]))
        freed = stage.until(lambda: not stage.is_held(job), seconds=5 * LEASE)
        return hit and freed
    finally:
        clock.set(0.0)
