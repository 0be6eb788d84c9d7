"""Two hosts on one machine: network namespaces, each with an end of a link (Linux, as root)."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from tests.servers import UnavailableError

STORES = "myoface-stores"
WORK = "myoface-work"
STORES_ADDRESS = "10.77.0.1"
WORK_ADDRESS = "10.77.0.2"
LINK = ("myo-stores", "myo-work")
"""The link's two ends; an interface's name has at most 15 letters."""


@dataclass(frozen=True)
class Link:
    """The link between the two hosts."""

    def cut(self) -> None:
        """Pull the plug: packets are lost, connections hear nothing."""
        _ip("-n", WORK, "link", "set", LINK[1], "down")

    def mend(self) -> None:
        """Plug it in again."""
        _ip("-n", WORK, "link", "set", LINK[1], "up")


@contextmanager
def two_hosts() -> Iterator[Link]:
    """Make the namespaces and the link; nothing of it is seen outside, and nothing is left.

    Raises
    ------
    UnavailableError
        If this machine does not allow it.
    """
    if shutil.which("ip") is None:
        raise UnavailableError("no ip here: apt-get install iproute2")
    try:
        for host in (STORES, WORK):
            _ip("netns", "add", host)
            _ip("-n", host, "link", "set", "lo", "up")
        ends = [LINK[0], "netns", STORES, "type", "veth", "peer", "name", LINK[1], "netns", WORK]
        _ip("link", "add", *ends)
        for host, end, address in (
            (STORES, LINK[0], STORES_ADDRESS),
            (WORK, LINK[1], WORK_ADDRESS),
        ):
            _ip("-n", host, "address", "add", f"{address}/24", "dev", end)
            _ip("-n", host, "link", "set", end, "up")
        yield Link()
    except subprocess.CalledProcessError as error:
        raise UnavailableError(f"no network namespaces here: {error.stderr.strip()}") from error
    finally:
        for host in (STORES, WORK):  # and the link with them
            subprocess.run(["ip", "netns", "delete", host], capture_output=True, check=False)


def inside(host: str) -> list[str]:
    """Return the words that run a command on a host."""
    return ["ip", "netns", "exec", host]


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)
