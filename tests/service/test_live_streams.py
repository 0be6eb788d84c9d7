"""What waits on its way to a live session, and who may connect to it."""

from __future__ import annotations

import time

import pytest

from service.access.principal import Principal, Scope
from service.errors import Problem
from service.live.tickets import Tickets
from service.queue.streams import MOST_FRAMES, MOST_WORDS, Answered, Inbox, Sent
from solver.kinds.live_messages import FollowedFrame, GivenFrame, Message

SESSION = "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11"
OTHER = "f2a6c0de-7d1b-4a54-8a55-5f9f3c8c9e02"
WHO = Principal("default", "abcdefghijkl", frozenset({Scope.READ, Scope.WRITE}))


def _frame(number: int, station: str = "a") -> Sent:
    return Sent(Message(b"%d" % number), number, station, is_frame=True)


def _word(number: int) -> Sent:
    return Sent(Message(b"{}", True), number, "a", is_frame=False)


def test_the_oldest_frames_go_and_words_stay() -> None:
    inbox = Inbox()
    inbox.add(_word(1))
    for number in range(2, MOST_FRAMES + 5):
        inbox.add(_frame(number))
    taken = [inbox.take().number for _ in range(MOST_FRAMES + 1)]
    assert taken == [1, *range(5, MOST_FRAMES + 5)]
    assert inbox.first is None
    assert inbox.dropped == 3


def test_frames_that_never_came_are_counted_of_each_station_for_itself() -> None:
    inbox = Inbox()
    for sent in (_frame(7), _frame(10), _frame(1, "b"), _frame(2, "b"), _frame(4, "b")):
        inbox.add(sent)
    assert inbox.dropped == 2 + 1


def test_words_are_bounded_too() -> None:
    inbox = Inbox()
    for number in range(1, 2 * MOST_WORDS):
        inbox.add(_word(number))
    inbox.add(_frame(2 * MOST_WORDS))
    taken = []
    while inbox.first is not None:
        taken.append(inbox.take())
    assert len(taken) == MOST_WORDS + 1
    assert taken[-1].is_frame


def test_entries_are_read_as_they_were_written() -> None:
    def kept(fields: dict[str, object]) -> dict[bytes, bytes]:
        return {
            name.encode(): value if isinstance(value, bytes) else str(value).encode()
            for name, value in fields.items()
        }

    for sent in (_frame(3), _word(4)):
        assert Sent.read(kept(sent.fields())) == sent
    answer = Answered(Message(b"\0\xff"), 2)
    assert Answered.read(kept(answer.fields())) == answer


@pytest.mark.parametrize("text", [b"[1]", b"{", b"\xff", b"1" * 10, b'{"a":' * 100_000])
def test_words_that_are_no_object_say_nothing(text: bytes) -> None:
    assert Message(text, True).words == {}
    assert Message(text, True).number == -1


def test_a_message_has_the_number_of_its_frame() -> None:
    given = GivenFrame(2**32 - 2, 0.5, b"")
    followed = FollowedFrame(2**32 - 2, 0.5, 1.0, 0.1, 0.2, 0, 0, b"")
    said = Message(b'{"number": 4294967294}', is_text=True)
    sent = (Message(given.pack()), Message(followed.pack()), said)
    assert [each.number for each in sent] == 3 * [2**32 - 2]
    assert [Message(data).number for data in (b"", given.pack()[:11])] == [-1, -1]


def test_a_ticket_is_good_for_its_session_and_role_until_its_time_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tickets = Tickets(b"s" * 32, 60)
    made, _ = tickets.make(SESSION, WHO, watch=True)
    ticket = tickets.verify(SESSION, made, "r")
    assert (ticket.session_id, ticket.is_station, ticket.who.tenant_id) == (
        SESSION,
        False,
        "default",
    )
    assert ticket.who.key_id == WHO.key_id
    assert (
        ticket.nonce
        != tickets.verify(SESSION, tickets.make(SESSION, WHO, watch=True)[0], "r").nonce
    )
    wrong = [
        (OTHER, made),
        (SESSION, "s" + made[1:]),
        (SESSION, made[:-1] + ("A" if made[-1] != "A" else "B")),
        (SESSION, made.replace(".default.", ".north.")),
        (SESSION, ""),
        (SESSION, "x" * 10_000),
    ]
    for session_id, given in wrong:
        with pytest.raises(Problem) as refused:
            tickets.verify(session_id, given, "r")
        assert refused.value.code == "ticket.invalid"
    with pytest.raises(Problem) as refused:
        Tickets(b"t" * 32, 60).verify(SESSION, made, "r")
    assert refused.value.code == "ticket.invalid"
    moment = time.time() + 61
    monkeypatch.setattr(time, "time", lambda: moment)
    with pytest.raises(Problem) as refused:
        tickets.verify(SESSION, made, "r")
    assert refused.value.code == "ticket.expired"
