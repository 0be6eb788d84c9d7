"""ZIPs from strangers: the members that are wanted, unpacked by plain names for a while."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from zipfile import ZipFile, ZipInfo

from solver.errors import file_error, quote
from solver.kinds import NOT_READABLE, check_directory, is_plainly_packed

HIDDEN = re.compile(r"(^|/)(\.|__MACOSX/)")  # what systems add that nobody sent

Member = tuple[PurePosixPath, ZipInfo]


@dataclass(frozen=True)
class ArchiveLimits:
    """What may be unpacked, and how an archive of more is refused."""

    most_bytes: int
    most_files: int
    code: str  # of the error
    what: str  # that is unpacked, in its words


@contextmanager
def unpacked(
    path: Path, limits: ArchiveLimits, choose: Callable[[Sequence[Member]], Sequence[Member]]
) -> Iterator[Path]:
    """Give a folder with those files of a ZIP that are chosen, by their names without folders.

    Raises :class:`~solver.errors.InputError` with the code of ``limits`` for a ZIP that is damaged
    or encrypted, has two chosen files of one name or unpacks to too much, and what ``choose`` does.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            with path.open("rb") as stream:
                check_directory(stream)
                with ZipFile(stream) as archive:
                    chosen = choose(
                        [
                            (PurePosixPath(member.filename), member)
                            for member in archive.infolist()
                            if not member.is_dir()
                            and not HIDDEN.search(member.filename.removeprefix("./"))
                        ]
                    )
                    _check(path.name, chosen, limits)
                    for place, member in chosen:
                        target = Path(folder) / place.name
                        with archive.open(member) as source, target.open("xb") as stream_out:
                            shutil.copyfileobj(source, stream_out)
        except NOT_READABLE as error:
            reason = f"it cannot be unpacked: {quote(error)}"
            raise file_error(limits.code, path.name, reason) from None
        yield Path(folder)


def _check(file: str, members: Sequence[Member], limits: ArchiveLimits) -> None:
    """Refuse what would unpack to too much, or over what was unpacked before."""
    size = sum(member.file_size for _, member in members)
    most = limits.most_bytes
    if size > most or len(members) > limits.most_files:
        reason = (
            f"{limits.what} are {len(members)} files of {size} bytes; at most "
            f"{limits.most_files} of {most} can be"
        )
        raise file_error(limits.code, file, reason, found=size, expected=most)
    seen = set()
    for place, member in members:
        name = place.name
        if not name.isprintable() or name in seen:
            reason = f"it holds {quote(name)} twice, or by a name that is none"
            raise file_error(limits.code, file, reason)
        if not is_plainly_packed(member):
            reason = f"{quote(name)} is encrypted, or packed in a way that is not read"
            raise file_error(limits.code, file, reason)
        seen.add(name)
