"""Connection slots of a process: no tenant, and nobody without a key, can take them all.

A connection is anonymous until a request on it has shown a key or a signed URL; from then on it
belongs to that tenant. A new one is always let in, since its first request may show a key, and
another one is closed for it where a bound is reached:

- at most half of the slots are anonymous, and few of one address: the oldest of the address with
  the most goes;
- a tenant has a bound of its own, and all tenants together leave a quarter of the slots to those
  that have yet to show a key: of the tenant, or else of the tenant with the most, the one that has
  been idle for longest goes, or where none is idle the one with the oldest request.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Generic, TypeVar

Connection = TypeVar("Connection")

# One slot of so many is left to connections that have yet to show a key
LEFT_TO_NEW = 4


class ConnectionSlots(Generic[Connection]):
    """Limit of connections: ``most``, ``most_of_address`` anonymous, ``most_of_tenant`` keyed."""

    def __init__(self, most: int, most_of_address: int, most_of_tenant: int) -> None:
        self._most = most
        self._most_of_address = most_of_address
        self._most_of_tenant = most_of_tenant
        self._addresses: dict[Connection, str] = {}
        self._tenants: dict[Connection, str] = {}
        # Both in the order in which they go: the oldest, those used longest ago
        self._anonymous: defaultdict[str, dict[Connection, None]] = defaultdict(dict)
        self._authenticated: defaultdict[str, dict[Connection, None]] = defaultdict(dict)
        self._busy: set[Connection] = set()

    @property
    def anonymous(self) -> int:
        """The number of connections that have shown no key."""
        return sum(map(len, self._anonymous.values()))

    def count_of_tenant(self, tenant_id: str) -> int:
        """Return the number of a tenant's connections."""
        return len(self._authenticated.get(tenant_id, ()))

    def open(self, connection: Connection, address: str) -> Connection | None:
        """Give a new connection a slot; returns the one to close for it."""
        self._addresses[connection] = address
        same = self._anonymous[address]
        same[connection] = None
        if len(same) > self._most_of_address:
            return self._free(next(iter(same)))
        is_full = len(self._addresses) > self._most and self.anonymous > 1
        if is_full or self.anonymous > self._most // 2:
            most = max(self._anonymous, key=lambda name: len(self._anonymous[name]))
            return self._free(next(iter(self._anonymous[most])))
        return None

    def authenticate(self, connection: Connection, tenant_id: str) -> Connection | None:
        """Note that a request has begun that is a tenant's; returns the connection to close for it.

        A proxy's connection may carry another tenant's request than before: it is the last one's.
        """
        address = self._addresses.get(connection)
        if address is None:
            return None  # it was closed meanwhile
        self._forget(connection, address)
        self._tenants[connection] = tenant_id
        self._authenticated[tenant_id][connection] = None
        self._busy.add(connection)
        if self.count_of_tenant(tenant_id) > self._most_of_tenant:
            return self._free(self._first_to_go(tenant_id))
        if len(self._tenants) > self._most - max(self._most // LEFT_TO_NEW, 1):
            most = max(self._authenticated, key=self.count_of_tenant)
            return self._free(self._first_to_go(most))
        return None

    def begin(self, connection: Connection) -> None:
        """Note that a request has begun, whosever it is: the connection is not idle."""
        if connection in self._addresses:
            self._busy.add(connection)

    def rest(self, connection: Connection) -> None:
        """Note that a connection's request has been answered: it is idle from now on."""
        self._busy.discard(connection)
        if tenant_id := self._tenants.get(connection):
            same = self._authenticated[tenant_id]
            same[connection] = same.pop(connection)

    def close(self, connection: Connection) -> None:
        """Free a connection's slot, if it has one still."""
        self._free(connection)

    def _first_to_go(self, tenant_id: str) -> Connection:
        same = self._authenticated[tenant_id]
        return next((each for each in same if each not in self._busy), next(iter(same)))

    def _free(self, connection: Connection) -> Connection:
        if (address := self._addresses.pop(connection, None)) is not None:
            self._forget(connection, address)
        return connection

    def _forget(self, connection: Connection, address: str) -> None:
        """Forget whose a connection has been."""
        self._busy.discard(connection)
        tenant_id = self._tenants.pop(connection, None)
        groups, name = (
            (self._anonymous, address) if tenant_id is None else (self._authenticated, tenant_id)
        )
        groups[name].pop(connection, None)
        if not groups[name]:
            del groups[name]
