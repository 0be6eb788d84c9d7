"""Drive shape keys in Blender by a live session: what `myoface live --to-osc` sends.

In Blender, with the face in the scene (docs/guide/studio-rig.md: studio.glb has ARKit's shapes):

    blender face.blend --python docs/examples/live_blender.py -- 9001 face

and beside it

    myoface live RIG --live-link 11111 --to-osc 127.0.0.1:9001

Shape keys that are called as the session's values are set, others stay. Nothing is installed: the
few forms of OSC that the station sends are read here.
"""

import socket
import struct
import sys

import bpy

VALUE = "/myoface/value/"
BUNDLE = b"#bundle\0"
LONGEST = 65536  # bytes of a packet
PAUSE_S = 1 / 120  # between two looks


def read_messages(packet):
    """Yield the addresses and numbers of a bundle of messages with numbers alone."""
    place = 16
    while packet.startswith(BUNDLE) and place + 4 <= len(packet):
        (length,) = struct.unpack_from(">i", packet, place)
        message = packet[place + 4 : place + 4 + length]
        place += 4 + max(length, 0)
        address, _, rest = message.partition(b"\0,")
        tags = rest.split(b"\0")[0].decode()
        sizes = {"f": 4, "i": 4, "d": 8}
        if not tags or set(tags) - set(sizes):
            return
        yield (
            address.strip(b"\0").decode(),
            struct.unpack(">" + tags, message[len(message) - sum(sizes[tag] for tag in tags) :]),
        )


class Receiver:
    """A timer of Blender's that sets shape keys by what has come since the last look."""

    def __init__(self, port, name):
        self.keys = bpy.data.objects[name].data.shape_keys.key_blocks
        for key in self.keys:
            key.slider_min = -1.0
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.setblocking(False)

    def __call__(self):
        """Take all packets that wait; the newest value of a key counts."""
        values = {}
        while True:
            try:
                packet = self.socket.recv(LONGEST)
            except BlockingIOError:
                break
            for address, numbers in read_messages(packet):
                if address.startswith(VALUE):
                    values[address.removeprefix(VALUE)] = numbers[0]
        for name, value in values.items():
            if name in self.keys:
                self.keys[name].value = value
        return PAUSE_S


def main():
    """Read the port and the object's name, and begin."""
    own = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    port, name = (own + ["9001", "face"][len(own) :])[:2]
    bpy.app.timers.register(Receiver(int(port), name), persistent=True)


if __name__ == "__main__":
    main()
