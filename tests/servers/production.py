"""PostgreSQL, Redis and S3 together, shared by many tests that each see them empty."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.servers.postgres import fresh_database, postgres
from tests.servers.redis import DATABASES, redis
from tests.servers.s3 import s3


class Production:
    """Running servers; each call of `fresh` gives a database, a queue and a prefix of its own."""

    def __init__(self, database_url: str, broker_url: str, files_url: str) -> None:
        self._database_url = database_url
        self._broker_url = broker_url
        self._files_url = files_url
        self._numbers = itertools.cycle(range(1, DATABASES))

    def fresh(self) -> dict[str, str]:
        """Return the environment of a service that has nothing yet."""
        number = next(self._numbers)
        bucket, _, query = self._files_url.partition("?")
        return {
            "MYOFACE_DATABASE_URL": fresh_database(self._database_url),
            "MYOFACE_BROKER_URL": f"{self._broker_url}/{number}",
            "MYOFACE_FILES_URL": f"{bucket}/{number}?{query}",
        }


@contextmanager
def production(folder: Path) -> Iterator[Production]:
    """Run the three servers.

    Raises
    ------
    UnavailableError
        If this machine lacks one of them.
    """
    with postgres() as database_url, redis(folder) as broker_url, s3(folder / "s3") as files_url:
        yield Production(database_url, broker_url, files_url)
