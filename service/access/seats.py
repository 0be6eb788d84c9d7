"""What holds a connection for long is counted: a process has few, for all tenants."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from service.access.principal import Principal
from service.errors import Problem

COME_BACK = "5"
"""Seconds after which what was refused may be asked for again."""


class Seats:
    """Seats in this process: at most so many of a tenant at a time, and so many of one key.

    ``code`` is of the problem of who gets none, ``kind`` says in it what there are too many of.
    """

    def __init__(self, code: str, kind: str, most_of_tenant: int, most_of_key: int) -> None:
        self._code = code
        self._kind = kind
        self._most_of_tenant = most_of_tenant
        self._most_of_key = most_of_key
        self._taken: Counter[tuple[str, ...]] = Counter()

    @contextmanager
    def seat(self, who: Principal) -> Iterator[None]:
        """Give ``who`` a seat.

        Raises
        ------
        Problem
            429 if the tenant or the key has as many as it may.
        """
        seats = {
            ("key", who.tenant_id, who.key_id): self._most_of_key,
            ("tenant", who.tenant_id): self._most_of_tenant,
        }
        for owner, most in seats.items():
            if self._taken[owner] >= most:
                problem = Problem(
                    429,
                    self._code,
                    f"{most} {self._kind} are open for this {owner[0]} already",
                    expected=most,
                )
                problem.headers = {"Retry-After": COME_BACK}
                raise problem
        self._taken.update(seats.keys())
        try:
            yield
        finally:
            self._taken.subtract(seats.keys())
            self._taken = +self._taken  # those that nobody has any more are forgotten
