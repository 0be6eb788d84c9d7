"""A Redis of one's own, on TCP with a password as in production."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.servers import UnavailableError, free_port, listening

PASSWORD = "only-for-tests"
DATABASES = 1024


@contextmanager
def redis(folder: Path, host: str = "127.0.0.1") -> Iterator[str]:
    """Run ``redis-server`` on a free port, with its data in ``folder``; gives its URL."""
    program = shutil.which("redis-server")
    if program is None:
        raise UnavailableError("no Redis here (redis-server): apt-get install redis-server")
    port = free_port(host)
    options = {
        "port": str(port),
        "bind": host,
        "requirepass": PASSWORD,
        "dir": str(folder),
        "databases": str(DATABASES),
        "save": "",
        "maxmemory-policy": "noeviction",
    }
    words = [word for key, value in options.items() for word in (f"--{key}", value)]
    with listening([program, *words], folder / "redis.log", host, port):
        yield f"redis://:{PASSWORD}@{host}:{port}"
