"""The channel between a live session's solver and the worker that holds it: a socket of messages.

A message is its length (4 bytes, little-endian), a byte that is 1 for text, and its data. The
worker keeps one end and passes the session's messages on; the solver process gets the other.
"""

from __future__ import annotations

import os
import select
import socket
import struct

from solver.kinds.live_messages import LONGEST, Message, MessageError

_HEADER = struct.Struct("<IB")
_PIECE = 1 << 20  # bytes that are received at once


class ChannelClosedError(ConnectionError):
    """The other end has gone."""


class Channel:
    """One end of a stream socket; each direction has one thread at most.

    It is read and written as a file is: a confined process may make no call of sockets.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._read = bytearray()

    @classmethod
    def pair(cls) -> tuple[Channel, Channel]:
        """Return both ends of a new channel."""
        one, other = socket.socketpair()
        return cls(one), cls(other)

    @classmethod
    def inherited(cls, number: int) -> Channel:
        """Return the end that a process was started with."""
        return cls(socket.socket(fileno=number))

    def fileno(self) -> int:
        """Return the file descriptor, to be handed to a process or waited for."""
        return self._end.fileno()

    def send(self, message: Message) -> None:
        """Send a message; raises :class:`ChannelClosedError`."""
        left = memoryview(_HEADER.pack(len(message.data), message.is_text) + message.data)
        try:
            while left:
                left = left[os.write(self.fileno(), left) :]
        except OSError as error:
            raise ChannelClosedError(str(error)) from error

    def receive(self, timeout: float | None = None) -> Message | None:
        """Return the next message, None if there is none within ``timeout`` seconds.

        Raises :class:`ChannelClosedError` at the end of the stream and :class:`MessageError` for a
        message that is too long.
        """
        while (message := self._next()) is None:
            if timeout is not None and not select.select([self._end], [], [], timeout)[0]:
                return None
            try:
                piece = os.read(self.fileno(), _PIECE)
            except OSError as error:
                raise ChannelClosedError(str(error)) from error
            if not piece:
                raise ChannelClosedError("the other end was closed")
            self._read += piece
        return message

    def close(self) -> None:
        """Close this end."""
        self._end.close()

    def _next(self) -> Message | None:
        """Return the message at the beginning of what was read, if it is whole."""
        if len(self._read) < _HEADER.size:
            return None
        length, is_text = _HEADER.unpack_from(self._read)
        if length > LONGEST:
            raise MessageError(f"a message of {length} bytes: {LONGEST} at most")
        end = _HEADER.size + length
        if len(self._read) < end:
            return None
        data = bytes(self._read[_HEADER.size : end])
        del self._read[:end]
        return Message(data, bool(is_text))
