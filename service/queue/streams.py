"""The streams of live sessions in the broker: what goes between a station and its session.

``live:<id>:in`` has what the station sent and ``live:<id>:out`` what the session answered, the
newest of either; ``live:<id>:told`` the last message of each type, for who joins later,
``live:<id>:station`` the connection that the station has, and ``live:<id>:read`` the last entry of
``in`` whose words a session has heard: those after it are for the next attempt. All go by
themselves when nobody writes any more: a session that is lost leaves nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

from solver.kinds.live_messages import Message

MOST_IN = 64  # messages that wait for a session, a second of a camera's
MOST_OUT = 64  # that wait for the slowest of those who watch
MOST_FRAMES = 16  # that wait in a process on their way to a session
MOST_WORDS = 64  # messages that wait there, beyond which words are not heard
KEPT_SECONDS = 300  # after the last write
LARGEST = 1 << 20  # bytes of a message of a station's
# Types of messages of which who joins later is told the last one, in this order
TOLD = ("preparing", "ready", "recording", "ended")
KEYS = ("in", "out", "told", "station", "read")

# Add a message of the station that has the session, or has it still after the broker was away
ADD = """
local holder = redis.call('GET', KEYS[2])
if holder and holder ~= ARGV[1] then return 0 end
redis.call('SET', KEYS[2], ARGV[1], 'EX', ARGV[3])
redis.call('XADD', KEYS[1], 'MAXLEN', ARGV[2], '*', unpack(ARGV, 4))
redis.call('EXPIRE', KEYS[1], ARGV[3])
return 1
"""

Fields = Mapping[bytes, bytes]


class Names(NamedTuple):
    """The keys of a session in the broker."""

    into: str
    out: str
    told: str
    station: str
    read: str

    @classmethod
    def of(cls, session_id: str) -> Names:
        """Return those of a session."""
        return cls(*(f"live:{session_id}:{key}" for key in KEYS))


class Sent(NamedTuple):
    """A message of a station's: which one it is of its connection, counted before any is dropped.

    One of the service's own has the number 0. A message that is no ``is_frame`` is never dropped
    for a newer one.
    """

    message: Message
    number: int
    station: str
    is_frame: bool

    def fields(self) -> dict[Any, Any]:
        """Return what the stream keeps of it."""
        kept = {"t": int(self.message.is_text), "f": int(self.is_frame), "n": self.number}
        return {"d": self.message.data, "s": self.station, **kept}

    @classmethod
    def read(cls, fields: Fields) -> Sent:
        """Return the message that an entry has."""
        message = Message(fields[b"d"], fields[b"t"] == b"1")
        return cls(message, int(fields[b"n"]), fields[b"s"].decode(), fields[b"f"] == b"1")


class Inbox:
    """Messages that wait on their way to a session: of its frames the newest, of words the first.

    ``dropped`` counts the frames that went, here or before they came here.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: deque[Sent] = deque()
        self._frames = 0
        self._station = ""
        self._number = 0

    def add(self, sent: Sent) -> None:
        """Add a message; where too many frames wait the oldest goes."""
        if sent.station != self._station:
            self._station = sent.station
            self._number = sent.number - 1
        self.dropped += max(sent.number - self._number - 1, 0)
        self._number = sent.number
        if not sent.is_frame and len(self._waiting) >= MOST_WORDS:
            return
        self._waiting.append(sent)
        self._frames += sent.is_frame
        if self._frames > MOST_FRAMES:
            self._waiting.remove(next(each for each in self._waiting if each.is_frame))
            self._frames -= 1
            self.dropped += 1

    @property
    def first(self) -> Sent | None:
        """The message that is next; None: there is none."""
        return self._waiting[0] if self._waiting else None

    def take(self) -> Sent:
        """Take the message that is next."""
        sent = self._waiting.popleft()
        self._frames -= sent.is_frame
        return sent


class Answered(NamedTuple):
    """A message of a session's, and the attempt that it is of: an earlier one's counts no more."""

    message: Message
    attempt: int

    def fields(self) -> dict[Any, Any]:
        """Return what the stream keeps of it."""
        return {"d": self.message.data, "t": int(self.message.is_text), "a": self.attempt}

    @classmethod
    def read(cls, fields: Fields) -> Answered:
        """Return the message that an entry has."""
        return cls(Message(fields[b"d"], fields[b"t"] == b"1"), int(fields[b"a"]))
