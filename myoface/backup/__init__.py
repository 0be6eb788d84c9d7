"""Backup and restore: the database as it was at a moment, and every file that it refers to.

The folder has ``manifest.json``, the dump that it names, ``files/``, the secret, and the list of
deletions. A backup never destroys the one before: all that is new has a new name, and only when the
new manifest is there does what nothing names any more go. Stored files never change, so the next
backup into the same folder copies only new ones.
"""

from myoface.backup.creation import back_up, note_deletions
from myoface.backup.restoration import restore, verify

__all__ = ["back_up", "note_deletions", "restore", "verify"]
