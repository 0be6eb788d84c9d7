"""What goes wrong in a machine room. Each blow tells whether it hit something."""

from __future__ import annotations

from collections.abc import Callable

from tests.campaigns.chaos.blows.backup import kill_backup
from tests.campaigns.chaos.blows.broker import empty_broker, kill_broker, pause_broker
from tests.campaigns.chaos.blows.clock import set_clock
from tests.campaigns.chaos.blows.disks import fill_database, fill_disk
from tests.campaigns.chaos.blows.files import flip_file, lose_file
from tests.campaigns.chaos.blows.lock import hold_lock
from tests.campaigns.chaos.blows.workers import (
    freeze_worker,
    kill_live,
    kill_solver,
    kill_worker,
    two_sweepers,
)
from tests.campaigns.chaos.stage import Stage

BLOWS: dict[str, Callable[[Stage], bool]] = {
    "kill-worker": kill_worker,
    "kill-solver": kill_solver,
    "kill-live": kill_live,
    "kill-broker": kill_broker,
    "kill-backup": kill_backup,
    "empty-broker": empty_broker,
    "pause-broker": pause_broker,
    "freeze-worker": freeze_worker,
    "two-sweepers": two_sweepers,
    "fill-disk": fill_disk,
    "fill-database": fill_database,
    "hold-lock": hold_lock,
    "set-clock": set_clock,
    "flip-file": flip_file,
    "lose-file": lose_file,
}
