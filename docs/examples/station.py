"""A capture station: every scan that the scanner saves is sent, checked, and judged in a line.

    python docs/examples/station.py /scans --url https://faces.example.com

Each folder in ``/scans`` is a person, each OBJ, PLY, GLB or STL in it a raw scan, named like its
file; one with ``neutral`` in its name is the neutral. Scan again into the same file, and the new
one takes the old one's place once it has arrived. The station may be stopped and started at any
time, on Windows as on Linux: what the service has already is not sent again. The key is taken from
``MYOFACE_API_KEY``, a proxy from ``HTTPS_PROXY``.
"""

import argparse
import hashlib
import sys
import time
from pathlib import Path

from myoface.client import Client
from myoface.errors import UNREACHABLE, ApiError
from myoface.names import NamedScan, by_files, name_scans
from myoface.resources import Capture

FORMATS = {".obj", ".ply", ".glb", ".stl"}
SUBJECT = ".myoface-subject"
"""The file in a person's folder that keeps the subject's id."""
PAUSE_S, SETTLED_S = 1.0, 2.0
"""Between two looks at the folder, and how long a file must not have changed to be whole."""

Version = tuple[int, int]
"""Size and time of change of a file."""


class Station:
    """Watches a folder; ``done`` are the files that are dealt with, as they were then."""

    def __init__(self, client: Client, folder: Path) -> None:
        self.client = client
        self.folder = folder
        self.done: dict[Path, Version] = {}

    def look(self) -> None:
        """Deal with every file that is new or has changed since the last look."""
        scans = [path for path in self.folder.glob("*/*") if path.suffix.lower() in FORMATS]
        for path in sorted(
            scans, key=lambda path: (by_files([path.name])[0][1] != "neutral", path)
        ):
            state = path.stat()
            version = (state.st_size, state.st_mtime_ns)
            if self.done.get(path) != version and time.time() - state.st_mtime > SETTLED_S:
                self.deal_with(path)
                self.done[path] = version

    def deal_with(self, path: Path) -> None:
        """Send and check a scan, and say what it is worth; a refusal is said too."""
        title = f"{path.parent.name}/{path.stem}"
        try:
            (scan,) = name_scans([path])
            self.require_alone(scan)
            subject = self.subject(path.parent)
            capture = self.sent(subject, scan)
            if capture.check:
                tell(f"{title}: {capture.check.verdict}, as before")
                return
            check = self.client.run("check_scan", subject, captures=[capture.id])
        except ApiError as error:
            if error.code == UNREACHABLE:
                raise
            tell(f"{title}: refused: {error}")
            return
        found = (check.result and check.result.summary) or {}
        tell(f"{title}: {found['verdict']}")
        for finding in found["findings"]:
            tell(f"    {finding['message']}: {finding['advice']}")

    def subject(self, folder: Path) -> str:
        """Return the subject's id of a person's folder, made at the first scan."""
        note = folder / SUBJECT
        if not note.exists():
            note.write_text(self.client.create_subject(folder.name).id, encoding="ascii")
        return note.read_text(encoding="ascii")

    def require_alone(self, scan: NamedScan) -> None:
        """Refuse a file that another one of the folder would take the place of, and again."""
        others = [path for path in scan.path.parent.iterdir() if path.suffix.lower() in FORMATS]
        same = [path for path in others if by_files([path.name])[0][0] == scan.name]
        name_scans(sorted(same))

    def sent(self, subject: str, scan: NamedScan) -> Capture:
        """Return the capture of a file; one of the same name from another file is replaced.

        The new file has arrived before the old capture goes.
        """
        digest = hashlib.sha256(scan.path.read_bytes()).hexdigest()
        known = {capture.name: capture for capture in self.client.captures(subject)}
        before = known.get(scan.name)
        if before and before.sha256 == digest:
            return before
        return self.client.add_capture(
            subject, scan.path, name=scan.name, role=scan.role, replaces=before and before.id
        )


def main() -> None:
    """Watch the folder of the command line until the station is stopped."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--url", default="http://127.0.0.1:8765")
    parser.add_argument("--once", action="store_true", help="look once, and end")
    given = parser.parse_args()
    with Client(given.url) as client:
        station = Station(client, given.folder)
        while True:
            try:
                station.look()
            except ApiError as error:
                tell(f"waiting for the service: {error}")
            if given.once:
                return
            time.sleep(PAUSE_S)


def tell(line: str) -> None:
    """Print a line at once, on a console of any code page."""
    line = line.encode(sys.stdout.encoding or "utf-8", "backslashreplace").decode(
        sys.stdout.encoding or "utf-8"
    )
    print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
