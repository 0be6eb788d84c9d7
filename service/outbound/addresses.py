"""Which addresses the service may call: public ones, and what the operator allows by name.

A customer names the receiver, so without a check the service would carry requests into the
network it runs in: to cloud metadata, to its own database, to a neighbour's router.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network

_GLOBAL_UNICAST = ipaddress.IPv6Network("2000::/3")
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")
# Not for receivers, whatever this Python's ``is_global`` thinks of them.
_SPECIAL: tuple[Network, ...] = (
    ipaddress.IPv4Network("100.64.0.0/10"),  # between a provider and its customers
    ipaddress.IPv4Network("168.63.129.16/32"),  # a cloud's own platform, inside it
    ipaddress.IPv4Network("192.0.0.0/24"),  # protocol assignments
    ipaddress.IPv4Network("192.88.99.0/24"),  # relays of 6to4
    ipaddress.IPv6Network("2001::/23"),  # protocol assignments, Teredo among them
    ipaddress.IPv6Network("2001:db8::/32"),  # documentation
    ipaddress.IPv6Network("3fff::/20"),  # documentation
)


def is_allowed(address: Address, allow: Sequence[Network] = ()) -> bool:
    """Return whether the service may connect to ``address``.

    Addresses that carry an IPv4 address (mapped, NAT64, 6to4) are judged by that one.
    """
    address = _carried(address)
    if is_named(address, allow):
        return True
    if address.is_multicast or any(_holds(network, address) for network in _SPECIAL):
        return False
    if address.version == 6 and not _holds(_GLOBAL_UNICAST, address):
        return False
    return address.is_global


def is_named(address: Address, allow: Sequence[Network]) -> bool:
    """Return whether the operator allows ``address`` by name."""
    return any(_holds(network, address) for network in allow)


def _carried(address: Address) -> Address:
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return address.ipv4_mapped
        if address.sixtofour is not None:
            return address.sixtofour
        if address in _NAT64:
            return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    return address


def _holds(network: Network, address: Address) -> bool:
    return network.version == address.version and address in network
