"""Seats: strangers give way to strangers, customers to nobody."""

from __future__ import annotations

from service.http.seats import Seats


def test_the_oldest_stranger_of_an_address_gives_way() -> None:
    seats = Seats[str](most=100, most_of_address=2)
    assert [seats.arrive(guest, "a") for guest in ("1", "2", "3", "4")] == [None, None, "1", "2"]
    assert seats.arrive("5", "b") is None
    assert seats.strangers == 3


def test_half_of_the_seats_are_not_for_strangers() -> None:
    seats = Seats[int](most=8, most_of_address=100)
    assert [seats.arrive(guest, "a") for guest in range(4)] == [None] * 4
    assert seats.arrive(4, "b") == 0  # of the address with the most
    assert seats.strangers == 4


def test_whoever_shows_a_key_keeps_the_seat() -> None:
    seats = Seats[int](most=4, most_of_address=1)
    seats.arrive(0, "a")
    seats.vouch(0)
    assert seats.arrive(1, "a") is None
    assert seats.arrive(2, "a") == 1
    for guest in (3, 4, 5):
        seats.arrive(guest, str(guest))
        seats.vouch(guest)
    # all seats are customers': who comes is one too many, and gives way to the next
    assert seats.arrive(6, "a") is None
    assert seats.arrive(7, "b") == 6


def test_who_has_left_is_forgotten() -> None:
    seats = Seats[int](most=4, most_of_address=1)
    seats.arrive(0, "a")
    seats.leave(0)
    seats.leave(0)
    seats.vouch(0)
    assert seats.arrive(1, "a") is None
    assert seats.strangers == 1
