"""Connection slots: which connection is closed for a new one."""

from __future__ import annotations

from service.http.slots import ConnectionSlots

MANY = 1000


def _filled(slots: ConnectionSlots[str], tenant: str, count: int) -> list[str]:
    """Return a tenant's new connections, all idle, the first for longest."""
    names = [f"{tenant}{number}" for number in range(count)]
    for name in names:
        assert slots.open(name, tenant) is None
        assert slots.authenticate(name, tenant) is None
        slots.rest(name)
    return names


def test_the_oldest_anonymous_one_of_an_address_goes() -> None:
    slots = ConnectionSlots[str](100, 2, MANY)
    assert [slots.open(name, "a") for name in ("1", "2", "3", "4")] == [None, None, "1", "2"]
    assert slots.open("5", "b") is None
    assert slots.anonymous == 3


def test_half_of_the_slots_are_not_for_anonymous_ones() -> None:
    slots = ConnectionSlots[str](8, 100, MANY)
    assert [slots.open(name, "a") for name in "0123"] == [None] * 4
    assert slots.open("4", "b") == "0"  # of the address with the most
    assert slots.anonymous == 4


def test_one_that_has_shown_a_key_gives_way_to_no_anonymous_one() -> None:
    slots = ConnectionSlots[str](8, 1, MANY)
    _filled(slots, "a", 5)
    assert [slots.open(name, name) for name in "1234567"] == [None, None, None, *"1234"]
    assert slots.count_of_tenant("a") == 5


def test_a_tenant_gives_way_to_itself_the_longest_idle_first() -> None:
    slots = ConnectionSlots[str](100, MANY, 3)
    _filled(slots, "a", 3)
    assert slots.authenticate("a0", "a") is None  # a request, so that a1 is idle for longest
    slots.rest("a0")
    slots.open("new", "x")
    assert slots.authenticate("new", "a") == "a1"
    assert slots.authenticate("a2", "a") is None
    slots.open("newer", "x")
    assert slots.authenticate("newer", "a") == "a0"  # the only one without a request
    slots.open("newest", "x")
    assert slots.authenticate("newest", "a") == "new"  # none is idle: the oldest request
    assert slots.count_of_tenant("a") == 3


def test_the_tenant_with_the_most_gives_way_to_another() -> None:
    slots = ConnectionSlots[str](16, MANY, 8)
    _filled(slots, "a", 7)
    _filled(slots, "b", 5)
    for number, gone in enumerate(("a0", "a1", "a2")):
        assert slots.open(f"c{number}", "c") is None
        assert slots.authenticate(f"c{number}", "c") == gone
    # a quarter of the slots is left to those that have yet to show a key
    assert [slots.count_of_tenant(tenant) for tenant in "abc"] == [4, 5, 3]


def test_a_connection_is_of_the_tenant_of_its_last_request() -> None:
    slots = ConnectionSlots[str](100, MANY, 2)
    slots.open("proxy", "x")
    for tenant in ("a", "b", "a"):
        slots.authenticate("proxy", tenant)
        slots.rest("proxy")
    assert (slots.count_of_tenant("a"), slots.count_of_tenant("b")) == (1, 0)


def test_one_that_is_closed_is_forgotten() -> None:
    slots = ConnectionSlots[str](4, 1, 1)
    slots.open("0", "a")
    slots.close("0")
    slots.close("0")
    assert slots.authenticate("0", "a") is None
    slots.rest("0")
    assert slots.open("1", "a") is None
    assert (slots.anonymous, slots.count_of_tenant("a")) == (1, 0)
