"""Files in a bucket of S3, or of a server that speaks its protocol (the extra ``s3``).

Credentials come from where every S3 client looks for them: ``AWS_ACCESS_KEY_ID`` and
``AWS_SECRET_ACCESS_KEY``, ``AWS_SHARED_CREDENTIALS_FILE``, or the role of the machine.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from boto3.exceptions import Boto3Error
from boto3.s3.transfer import TransferConfig
from boto3.session import Session
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError

from service.store.files.base import CHUNK, Blob, Files, StoredFile, UnreachableError, copy_plain

PARTS = TransferConfig(multipart_threshold=64 << 20, multipart_chunksize=16 << 20)
# One request copies up to 5 GB, and not every server can copy parts
COPIES = TransferConfig(multipart_threshold=5 << 30)

CONFIG = Config(
    connect_timeout=5,
    read_timeout=30,
    retries={"max_attempts": 3, "mode": "standard"},
    s3={"addressing_style": "path"},
    # The checksums that newer clients add by themselves are not known to every server.
    request_checksum_calculation="when_required",
    response_checksum_validation="when_required",
    max_pool_connections=32,
)
MISSING = frozenset({"NoSuchKey", "NotFound", "404"})
RESUMES = 3
DEFAULT_REGION = "us-east-1"


class S3Files(Files):
    """Objects ``<prefix>files/ab/abcdef...`` in a bucket, and ``<prefix>aside/...``."""

    def __init__(
        self, bucket: str, prefix: str, endpoint: str | None = None, region: str | None = None
    ) -> None:
        self._bucket = bucket
        self._files = f"{prefix}files/"
        self._aside = f"{prefix}aside/"
        self._client: Any = Session().client(
            "s3", endpoint_url=endpoint, region_name=region or DEFAULT_REGION, config=CONFIG
        )

    @classmethod
    def at(cls, url: str) -> S3Files:
        """Return the files at ``s3://bucket/prefix?endpoint=http://host:port&region=name``."""
        parts = urlsplit(url)
        if not parts.netloc:
            raise ValueError(f"{url} names no bucket: s3://bucket/prefix?endpoint=...")
        query = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        if unknown := query.keys() - {"endpoint", "region"}:
            raise ValueError(f"{url}: only endpoint and region are known, not {sorted(unknown)}")
        prefix = parts.path.strip("/")
        return cls(parts.netloc, f"{prefix}/" if prefix else "", **query)

    def put(self, source: Path, most: int | None = None) -> Blob:
        """Store a copy of ``source`` of at most ``most`` bytes; it is there whole or not at all.

        Also if it is there already: the new date keeps it from the garbage collection.
        """
        # what is sent must be what was hashed, and others may be writing the source
        with tempfile.TemporaryFile(dir=source.parent) as copy:
            blob = copy_plain(source, copy, most)
            copy.seek(0)
            with _translate_errors():
                key = self._key(blob.sha256)
                self._client.upload_fileobj(copy, self._bucket, key, Config=PARTS)
        return blob

    def open(self, sha256: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        """Give the bytes from ``start`` to before ``end``; a missing file is known at once."""
        if end is not None and end <= start:
            return iter(())
        key, size = self._find(sha256)
        last = size if end is None else min(end, size)
        return self._blocks(key, start, last)

    def size(self, sha256: str) -> int:
        """Return the size in bytes."""
        return self._find(sha256)[1]

    def list_stored(self) -> Iterator[StoredFile]:
        """List what is stored and not put aside."""
        return self._list(self._files)

    def put_aside(self, sha256: str) -> None:
        """Take a file out of the list; it can still be read."""
        self._copy(self._key(sha256), self._aside + sha256)
        self._delete(self._key(sha256))

    def list_aside(self) -> Iterator[StoredFile]:
        """List what was put aside, and when."""
        return self._list(self._aside)

    def take_back(self, sha256: str) -> None:
        """Put a file that was put aside where it was."""
        self._copy(self._aside + sha256, self._key(sha256))
        self._delete(self._aside + sha256)

    def remove(self, sha256: str) -> None:
        """Remove a file that was put aside, for good."""
        self._delete(self._aside + sha256)

    def remove_unfinished(self, before: datetime) -> None:
        """Do nothing: parts of interrupted uploads are for the bucket's own lifecycle rule."""

    def ready(self) -> bool:
        """Return whether the bucket answers and is ours."""
        try:
            with _translate_errors():
                self._client.head_bucket(Bucket=self._bucket)
        except OSError:
            return False
        return True

    def _key(self, sha256: str) -> str:
        return f"{self._files}{sha256[:2]}/{sha256}"

    def _find(self, sha256: str) -> tuple[str, int]:
        """Return key and size of a file, which may have been put aside or taken back just now."""
        for key in (self._key(sha256), self._aside + sha256, self._key(sha256)):
            with _translate_errors(missing_is_fine=True):
                found = self._client.head_object(Bucket=self._bucket, Key=key)
                return key, found["ContentLength"]
        raise FileNotFoundError(sha256)

    def _blocks(self, key: str, start: int, end: int) -> Iterator[bytes]:
        """Give the bytes of an object; a connection that breaks is taken up where it broke."""
        failures = 0
        while start < end:
            try:
                with _translate_errors():
                    answer = self._client.get_object(
                        Bucket=self._bucket, Key=key, Range=f"bytes={start}-{end - 1}"
                    )
                    with closing(answer["Body"]) as body:
                        for block in body.iter_chunks(CHUNK):
                            start += len(block)
                            yield block
            except UnreachableError:
                failures += 1
                if failures > RESUMES:
                    raise

    def _list(self, prefix: str) -> Iterator[StoredFile]:
        with _translate_errors():
            pages = self._client.get_paginator("list_objects_v2").paginate(
                Bucket=self._bucket, Prefix=prefix
            )
            for page in pages:
                for item in page.get("Contents", ()):
                    yield StoredFile(item["Key"].rpartition("/")[2], item["LastModified"])

    def _copy(self, source: str, target: str) -> None:
        with _translate_errors():
            self._client.copy(
                {"Bucket": self._bucket, "Key": source}, self._bucket, target, Config=COPIES
            )

    def _delete(self, key: str) -> None:
        with _translate_errors():
            self._client.delete_object(Bucket=self._bucket, Key=key)


@contextmanager
def _translate_errors(*, missing_is_fine: bool = False) -> Iterator[None]:
    """Turn the client's errors into those of a file system."""
    try:
        yield
    except ClientError as error:
        if error.response["Error"]["Code"] not in MISSING:
            raise UnreachableError(str(error)) from error
        if not missing_is_fine:
            raise FileNotFoundError(str(error)) from error
    except (BotoCoreError, Boto3Error) as error:
        raise UnreachableError(str(error)) from error
