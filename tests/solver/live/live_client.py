"""The client's end of a job that holds a session, in a thread of the test."""

import json
import threading

import numpy as np

from solver.errors import InputError
from solver.jobs import run_job
from solver.kinds.live_channel import Channel
from solver.kinds.live_messages import FollowedFrame, GivenFrame, Message

OPEN = np.zeros(52, "<f4")  # weights of a face at rest


class Client:
    """Says and hears what a station does."""

    def __init__(self, files, out, *, resume=False, **options):
        self.channel, theirs = Channel.pair()
        self.left = None
        self.error = None

        def hold():
            try:
                given = {"check_seconds": 0, **options}
                session = {"options": given, "channel": theirs, "resume": resume}
                self.left = run_job("live_session", out, **session, **files)
            except InputError as error:
                self.error = error

        self.thread = threading.Thread(target=hold)
        self.thread.start()

    def say(self, **said):
        self.channel.send(Message.of(said))

    def frame(self, number, seconds, numbers=OPEN):
        self.channel.send(Message(GivenFrame(number, seconds, numbers.tobytes()).pack()))

    def hear(self, wanted=None):
        """Return the next message, the next of a type if one is wanted."""
        while True:
            message = self.channel.receive(60.0)
            assert message is not None
            if not message.is_text:
                found = FollowedFrame.unpack(message.data)
                if wanted is None:
                    return found
                continue
            found = json.loads(message.data)
            if wanted is None or found["type"] == wanted:
                return found

    def followed(self):
        while isinstance(found := self.hear(), dict):
            pass
        return found
