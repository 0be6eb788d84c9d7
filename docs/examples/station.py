"""A capture station: every scan that the scanner saves is sent, checked, and judged in a line.

    python station.py /scans --url https://faces.example.com

Each folder in ``/scans`` is a person, each OBJ, PLY, GLB or STL in it (no XYZ) a raw scan, named
like its file; one with ``neutral``, ``neutre``, ``rest`` or ``relaxed`` as a word of its name is
the neutral. Scan again into the same file, and the new one takes the old one's place. The station
may be stopped and started at any time, on Windows as on Linux: what the service has already is not
sent again. A line that is down, a key that is refused or a file that cannot be read is waited for.
The key is taken from ``MYOFACE_API_KEY``, a proxy from ``HTTPS_PROXY``.
"""

import argparse
import sys
import time
from pathlib import Path

from myoface.client import Client
from myoface.errors import ApiError
from myoface.names import NamedScan, by_files, name_scans, same_file

FORMATS = {".obj", ".ply", ".glb", ".stl"}
SUBJECT = ".myoface-subject"
"""The file in a person's folder that keeps the subject's id."""
PAUSE_S = 1.0
SETTLED_S = 2.0
"""Between two looks at the folder, and how long a file must not have changed to be whole."""
REFUSED = {404, 409, 410, 413, 422}
BUSY = "subject.busy"
"""A scan is replaced when no job reads the person's scans: later, then."""

Version = tuple[int, int]
"""Size and time of change of a file."""


class Station:
    """Watches a folder.

    ``options`` are those of its checks. ``done`` are the files that are dealt with, as they were
    then, ``waits`` what was said to be waited for.
    """

    def __init__(
        self, client: Client, folder: Path, options: dict[str, str | float] | None = None
    ) -> None:
        self.client = client
        self.folder = folder
        self.options = options or {}
        self.done: dict[Path, Version] = {}
        self.waits: set[str] = set()

    def look(self) -> None:
        """Deal with every file that is new or has changed since the last look.

        Raises
        ------
        ApiError
            If the service cannot be asked now; the files are dealt with at a later look.
        """
        scans = [path for path in self.folder.glob("*/*") if path.suffix.lower() in FORMATS]
        for path in sorted(
            scans, key=lambda path: (by_files([path.name])[0][1] != "neutral", path)
        ):
            try:
                self.look_at(path)
            except OSError as error:  # the scanner has it still, or the share is away
                self.wait(f"{path.parent.name}/{path.name}: {error.strerror or error}")

    def look_at(self, path: Path) -> None:
        """Deal with a file if it is whole and has changed."""
        state = path.stat()
        version = (state.st_size, state.st_mtime_ns)
        if self.done.get(path) == version or time.time() - state.st_mtime <= SETTLED_S:
            return
        title = f"{path.parent.name}/{path.stem}"
        try:
            self.deal_with(path, title)
        except ApiError as error:
            if error.code == BUSY:
                self.wait(f"{title}: waits for the person's jobs")
                return
            if not is_refusal(error):
                raise
            tell(f"{title}: refused: {error}")
        self.done[path] = version
        self.waits.clear()

    def deal_with(self, path: Path, title: str) -> None:
        """Send and check a scan, and say what it is worth."""
        (scan,) = name_scans([path])
        self.require_alone(scan)
        subject = self.subject(path.parent)
        capture = self.client.ensure_capture(
            subject, path, name=scan.name, role=scan.role, replace=True
        )
        if capture.check:
            tell(f"{title}: {capture.check.verdict}, as before")
            return
        check = self.client.run("check_scan", subject, captures=[capture.id], options=self.options)
        found = (check.result and check.result.summary) or {}
        tell(f"{title}: {found['verdict']}")
        for finding in found["findings"]:
            tell(f"    {finding['message']}: {finding['advice']}")
        for part in found.get("judged", []):
            if not part["judged"]:
                tell(f"    not judged: {part['about']}: {part['words']}")

    def wait(self, why: str) -> None:
        """Say once what is waited for."""
        if why not in self.waits:
            tell(f"waiting: {why}")
        self.waits.add(why)

    def subject(self, folder: Path) -> str:
        """Return the subject's id of a person's folder, made at the first scan."""
        note = folder / SUBJECT
        if not note.exists():
            note.write_text(self.client.create_subject(folder.name).id, encoding="ascii")
        return note.read_text(encoding="ascii")

    def require_alone(self, scan: NamedScan) -> None:
        """Refuse a file that another one of the folder would take the place of, and again."""
        others = [path for path in scan.path.parent.iterdir() if path.suffix.lower() in FORMATS]
        name = same_file(scan.name)
        same = [path for path in others if same_file(by_files([path.name])[0][0]) == name]
        name_scans(sorted(same))


def is_refusal(error: ApiError) -> bool:
    """Return True if a file is refused, or its check has failed: asking again changes nothing."""
    if error.status is None:
        return error.code == "client.name" or not error.code.startswith("client.")
    return error.status in REFUSED


def main() -> None:
    """Watch the folder of the command line until the station is stopped."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--url", default="http://127.0.0.1:8765")
    parser.add_argument("--once", action="store_true", help="look once, and end")
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        "--unit", type=read_unit, help="of the scans: mm, cm, m, inch, foot, or its mm"
    )
    size.add_argument("--eye-distance", type=float, help="or between the person's pupils, in mm")
    given = parser.parse_args()
    options = {"unit": given.unit, "eye_distance_mm": given.eye_distance}
    options = {name: value for name, value in options.items() if value is not None}
    with Client(given.url) as client:
        station = Station(client, given.folder, options)
        while True:
            try:
                station.look()
            except (ApiError, OSError) as error:
                station.wait(str(error))
            if given.once:
                return
            time.sleep(PAUSE_S)


def read_unit(word: str) -> str | float:
    """Return a unit's name, or how many mm it has."""
    try:
        return float(word)
    except ValueError:
        return word


def tell(line: str) -> None:
    """Print a line at once, on a console of any code page."""
    line = line.encode(sys.stdout.encoding or "utf-8", "backslashreplace").decode(
        sys.stdout.encoding or "utf-8"
    )
    print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
