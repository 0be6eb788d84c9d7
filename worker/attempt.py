"""The folder of one attempt: the inputs under their users' names, the outputs, the verdict."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from service.bounds import ERROR, SUMMARY, fit, fit_result, refuse_constant
from service.queue.table import Claim
from service.queue.wakeups import LIVE
from service.store.database import Store
from service.store.files import Files, LargerFileError
from service.store.integrity import find_fault, note_fault
from service.store.models import Artifact, Rig
from solver.kinds import FILES, KINDS
from solver.kinds.live_session import PART
from worker.errors import InvalidOutputError, LostInputError
from worker.orphans import remove_attempt

MEDIA_TYPES = {
    ".glb": "model/gltf-binary",
    ".npz": "application/x-npz",
    ".json": "application/json",
    ".png": "image/png",
    ".ply": "model/ply",
    ".csv": "text/csv",
    ".usdc": "model/vnd.usd",
    ".html": "text/html",
    ".mp4": "video/mp4",
}


# The folder in `out` of a sequence's or simulation's frames, files `<first>-<last>.json`
FRAMES = "frames"

# Bytes of a result: its summary, and the names of its expressions
LARGEST_RESULT = 2 * SUMMARY.size

CHUNK = re.compile(r"[0-9]{1,9}-[0-9]{1,9}\.json")
MOST_ARTIFACTS = 200
# Names in a folder of outputs, beside the frames of earlier attempts: the frames of a day, of which
# a job writes a file every two seconds if it is slow
MOST_NAMES = 50_000
# Names and depth of all an attempt's folder
MOST_ENTRIES = 200_000
DEEPEST = 100
ARTIFACT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,254}")

# Files in `out` that take minutes: the next attempt goes on with what is in them
KEPT = tuple(name for name, file in FILES.items() if file.is_kept)


class AttemptFolder:
    """``<work>/<job>.<attempt>`` with ``job.json``, ``inputs/``, ``out/`` and ``tmp/``.

    The solver leaves ``result.json`` or ``error.json`` beside them.
    """

    def __init__(self, work: Path, claim: Claim) -> None:
        self.path = work / f"{claim.job_id}.{claim.attempt}"
        self._claim = claim
        self._stored = set(claim.frames)
        self._written: dict[str, int] = {}
        self._replaceable: dict[str, int] = {}
        self._outputs: dict[Path, int] = {}
        self._chunks: dict[Path, int] = {}
        self._staged = 0
        self._keeps = {*KEPT, *claim.kept}

    def keep(self, names: Iterable[str]) -> None:
        """Keep further files of ``out`` for the next attempt, as soon as they are written."""
        self._keeps.update(names)

    def stage(self, store: Store) -> None:
        """Fetch the inputs, and the frames and files that earlier attempts left.

        Each input has a folder of its own: two may have the same file name.

        Raises
        ------
        LostInputError
            If one of them is lost or damaged.
        """
        (self.path / "out").mkdir(parents=True)
        inputs = []
        for number, item in enumerate(self._claim.inputs):
            path = self.path / "inputs" / str(number) / item["filename"]
            _fetch(store, item, path)
            inputs.append({**item, "path": str(path)})
        for name, sha256 in self._claim.frames.items():
            _fetch(store, _as_input("frames", name, sha256), self.path / "out" / FRAMES / name)
        for name, sha256 in self._claim.kept.items():
            kept = self.path / "out" / name
            _fetch(store, _as_input("result so far", name, sha256), kept)
            self._written[name] = kept.stat().st_mtime_ns
            self._replaceable[name] = kept.stat().st_size
        has_left = self._take_over()
        job = {
            "kind": self._claim.kind,
            "inputs": inputs,
            "options": self._claim.options,
            "resume": bool(self._claim.frames or self._claim.kept or has_left),
        }
        (self.path / "job.json").write_text(json.dumps(job))
        self._staged = self._disk_bytes()

    def _take_over(self) -> bool:
        """Take over what earlier attempts at a live session left here; return whether any did.

        It is newer than what was stored of it: takes that ended after the last beat, and the one
        that was being recorded.
        """
        if KINDS[self._claim.kind].queue != LIVE:
            return False
        found = False
        for attempt in range(1, self._claim.attempt):
            earlier = AttemptFolder(self.path.parent, replace(self._claim, attempt=attempt))
            for path in earlier._left():
                with suppress(FileNotFoundError):  # the sweeper was faster
                    path.rename(self.path / "out" / path.name)
                    found = True
                    if not path.name.endswith(PART):
                        self._keeps.add(path.name)
        return found

    def error(self) -> dict[str, Any] | None:
        """Return the solver's error, if it reported one.

        Raises
        ------
        InvalidOutputError
            For one that no solver of ours writes.
        """
        found = self._read("error.json", ERROR.size)
        if found is not None and not isinstance(found.get("code"), str):
            raise InvalidOutputError("the solver left an error without a code")
        return None if found is None else fit({"code": found["code"], **found}, ERROR)

    def result(self) -> dict[str, Any] | None:
        """Return the solver's result, if it finished; raises as `error` does."""
        found = self._read("result.json", LARGEST_RESULT)
        if found is None:
            return None
        names = found.get("expressions")
        if not isinstance(found.get("summary"), dict) or not isinstance(names, list):
            raise InvalidOutputError("the solver left a result without a summary or expressions")
        formats = found.get("formats")
        return fit_result(found["summary"], names, formats if isinstance(formats, dict) else {})

    def store(self, files: Files, formats: Mapping[str, int]) -> list[Artifact]:
        """Put the outputs that were measured last into the file store.

        ``formats`` are the numbers of their formats, of those that have one.
        """
        paths = sorted(self._outputs)
        if len(paths) > MOST_ARTIFACTS:
            count = f"{len(paths)} files: {MOST_ARTIFACTS} are the most"
            raise InvalidOutputError(f"the solver left {count}")
        try:
            return [self._put(path, files, formats.get(path.name)) for path in paths]
        except LargerFileError as error:
            raise InvalidOutputError(f"{error.filename} grew after the solver's end") from error

    @property
    def input_bytes(self) -> int:
        """The bytes of all inputs."""
        return sum(path.stat().st_size for path in (self.path / "inputs").glob("*/*"))

    @property
    def written_bytes(self) -> int:
        """The bytes on disk of what the solver wrote, wherever in the folder.

        Raises InvalidOutputError if it cannot be counted.
        """
        return self._disk_bytes() - self._staged

    def measure(self) -> int:
        """Measure all outputs, stored or not; returns their bytes.

        Until the next call no other ones and no more bytes of these are stored.

        Raises
        ------
        InvalidOutputError
            If there are more than any job of ours leaves.
        """
        # frames first: what they were made with is whole then
        self._chunks, self._outputs = self._left(FRAMES), self._left()
        return sum((*self._chunks.values(), *self._outputs.values()))

    def unstored_bytes(self, *, at_end: bool = False) -> int:
        """Return the measured bytes that are due to be stored and take no stored file's place.

        While the solver works these are frames and files to go on with, at the end all.
        """
        due = {
            path: size for path, size in self._outputs.items() if at_end or path.name in self._keeps
        }
        new = sum(size for path, size in due.items() if self._is_new(path))
        new -= sum(self._replaceable.get(path.name, 0) for path in due if self._is_new(path))
        return max(new + sum(self._chunks[path] for path in self._unstored_frames()), 0)

    def new_frames(self, files: Files) -> list[dict[str, Any]]:
        """Put the measured frames that are new into the file store; returns rows."""
        rows = []
        for path in sorted(self._unstored_frames()):
            first, last = map(int, path.stem.split("-"))
            try:
                blob = files.put(path, self._chunks[path])
            except LargerFileError as error:
                raise InvalidOutputError(f"{path.name} grew after it was ready") from error
            rows.append({"first": first, "last": last, "size": blob.size, "sha256": blob.sha256})
            self._stored.add(path.name)
        return rows

    def new_kept(self, files: Files) -> dict[str, Artifact]:
        """Put files to go on with that were written since the last call into the file store."""
        found = {}
        due = (each for each in self._outputs if each.name in self._keeps)
        for path in filter(self._is_new, due):
            written = path.stat().st_mtime_ns
            with suppress(LargerFileError):  # written anew since it was measured: the next time
                found[path.name] = self._put(path, files)
                self._written[path.name] = written
                self._replaceable[path.name] = found[path.name].size
        return found

    @property
    def frames(self) -> int:
        """The number of frames that are in the file store."""
        spans = (name.removesuffix(".json").split("-") for name in self._stored)
        return sum(int(last) - int(first) + 1 for first, last in spans)

    @property
    def kept(self) -> list[str]:
        """The names of files to go on with that are in the file store."""
        return sorted({*self._claim.kept, *self._written})

    def rig(self, result: dict[str, Any]) -> Rig | None:
        """Return the rig, if this kind of job leaves one."""
        if KINDS[self._claim.kind].given(self._claim.options).leaves != "rig":
            return None
        return Rig(
            tenant_id=self._claim.tenant_id,
            subject_id=self._claim.subject_id,
            job_id=self._claim.job_id,
            model_job_id=self._claim.model_job_id,
            parent_id=self._claim.rig_id,
            expressions=result["expressions"],
            summary=result["summary"],
        )

    def remove(self) -> None:
        """Remove the folder."""
        remove_attempt(self.path)

    def _unstored_frames(self) -> Iterator[Path]:
        if KINDS[self._claim.kind].frames:
            for path in self._chunks:
                if path.name not in self._stored and CHUNK.fullmatch(path.name):
                    yield path

    def _is_new(self, path: Path) -> bool:
        """Tell whether a file was written since it was stored as one to go on with, if it was."""
        return path.name not in self._keeps or path.stat().st_mtime_ns != self._written.get(
            path.name
        )

    def _left(self, folder: str = ".") -> dict[Path, int]:
        """Return the plain files in ``out`` or a folder of it and their bytes.

        Never what a link leads to. The solver reads strangers' files: a link that it left could
        lead to the service's secret.
        """
        out = self.path / "out"
        place = out / folder
        most = MOST_NAMES + len(self._claim.frames)
        found: dict[Path, int] = {}
        if not place.is_dir() or out.is_symlink() or place.is_symlink():
            return found
        with os.scandir(place) as entries:
            for number, entry in enumerate(entries):
                if number >= most:
                    raise InvalidOutputError(f"the solver left more than {most} files")
                with suppress(FileNotFoundError):  # it may rename some at this moment
                    if entry.is_file(follow_symlinks=False) and ARTIFACT.fullmatch(entry.name):
                        found[place / entry.name] = entry.stat(follow_symlinks=False).st_size
        return found

    def _disk_bytes(self) -> int:
        """Return the bytes on disk of all that is in the folder."""
        total = seen = 0
        folders = [(self.path, 0)]
        while folders:
            folder, depth = folders.pop()
            try:
                with os.scandir(folder) as entries:
                    for entry in entries:
                        seen += 1
                        if seen > MOST_ENTRIES or depth > DEEPEST:
                            raise InvalidOutputError("the solver wrote too many or too deep files")
                        with suppress(FileNotFoundError):
                            total += entry.stat(follow_symlinks=False).st_blocks * 512
                            if entry.is_dir(follow_symlinks=False):
                                folders.append((folder / entry.name, depth + 1))
            except (FileNotFoundError, NotADirectoryError):  # it goes on working
                continue
            except PermissionError as error:
                raise InvalidOutputError(f"the solver closed {folder.name}") from error
        return total

    def _put(self, path: Path, files: Files, format_number: int | None = None) -> Artifact:
        blob = files.put(path, self._outputs[path])
        return Artifact(
            tenant_id=self._claim.tenant_id,
            job_id=self._claim.job_id,
            name=path.name,
            size=blob.size,
            sha256=blob.sha256,
            media_type=MEDIA_TYPES.get(path.suffix, "application/octet-stream"),
            format=format_number,
        )

    def _read(self, name: str, most: int) -> dict[str, Any] | None:
        """Return a document of at most ``most`` bytes that the solver left; None: it left none.

        The solver reads strangers' files, and one of them may have taken it over.
        """
        try:
            # neither through a link nor waiting at a pipe
            plain = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
            with os.fdopen(os.open(self.path / name, plain), "rb") as file:
                content = file.read(most + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise InvalidOutputError(f"the solver left {name} that is no file") from error
        if len(content) > most:
            raise InvalidOutputError(f"the solver left {name} of more than {most} bytes")
        try:
            found = json.loads(content, parse_constant=refuse_constant)
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise InvalidOutputError(f"the solver left {name} that is no JSON object")
        return found


def _as_input(role: str, name: str, sha256: str) -> dict[str, Any]:
    """Describe what an earlier attempt left as an input is described."""
    return {"role": role, "name": name, "filename": name, "sha256": sha256}


def _fetch(store: Store, item: dict[str, Any], path: Path) -> None:
    """Fetch a file; raises if it is the file that is at fault, not its store or this disk."""
    try:
        store.files.fetch(item["sha256"], path)
    except OSError as error:
        fault = find_fault(store.files, item["sha256"])
        if fault is None:
            raise
        note_fault(store, item["sha256"], fault)
        raise LostInputError(item, fault) from error
