"""Seats: the connections of a process, half of which strangers cannot take.

Whoever has shown no key yet is a stranger, and so is everybody at first. One that comes when all
seats of strangers are taken is let in, and the stranger who has waited longest at the address with
the most of them has to go: a customer needs a moment to show a key, and keeps the seat then.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Generic, TypeVar

Guest = TypeVar("Guest")


class Seats(Generic[Guest]):
    """At most ``most`` connections, half of them strangers', ``most_of_address`` of one address."""

    def __init__(self, most: int, most_of_address: int) -> None:
        self._most = most
        self._most_of_address = most_of_address
        self._addresses: dict[Guest, str] = {}
        self._strangers: defaultdict[str, dict[Guest, None]] = defaultdict(dict)

    @property
    def strangers(self) -> int:
        """The strangers' number."""
        return sum(map(len, self._strangers.values()))

    def arrive(self, guest: Guest, address: str) -> Guest | None:
        """Give a stranger a seat; returns who has to go for it.

        Where all others have shown a key there is one too many, who is to be told so.
        """
        self._addresses[guest] = address
        same = self._strangers[address]
        same[guest] = None
        if len(same) > self._most_of_address:
            return self._show_out(same)
        is_full = len(self._addresses) > self._most and self.strangers > 1
        if is_full or self.strangers > self._most // 2:
            return self._show_out(max(self._strangers.values(), key=len))
        return None

    def vouch(self, guest: Guest) -> None:
        """Note that a guest is no stranger any more."""
        address = self._addresses.get(guest)
        if address is not None:
            self._strangers[address].pop(guest, None)
            if not self._strangers[address]:
                del self._strangers[address]

    def leave(self, guest: Guest) -> None:
        """Free a guest's seat, if it has one still."""
        self.vouch(guest)
        self._addresses.pop(guest, None)

    def _show_out(self, strangers: dict[Guest, None]) -> Guest:
        oldest = next(iter(strangers))
        self.leave(oldest)
        return oldest
