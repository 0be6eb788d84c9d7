"""Frames that Epic's app Live Link Face sends by UDP, as version 6 of its packets has them.

A packet is, numbers big-endian: the version (1 byte), the device's and the subject's name (a length
in 4 bytes and as many bytes of UTF-8), the frame's number (int32) and what is beyond it (float32),
the rate as numerator and denominator (two int32), how many values follow (1 byte), and these
(float32): ARKit's blendshapes in Unreal's order, then yaw, pitch and roll of head and eyes, in rad.
"""

from __future__ import annotations

import struct
from math import isfinite

from myoface.client import Timed
from myoface.live.datagrams import PacketError

PORT = 11111  # to which the app sends unless it is told another
VERSION = 6
LONGEST_NAME = 256  # bytes
# frames a second
LEAST_RATE = 1.0
MOST_RATE = 1000.0
MOST = 1e3  # of a value: weights are about 1, angles at most 2 pi

_EYE = ("Blink", "LookDown", "LookIn", "LookOut", "LookUp", "Squint", "Wide")
_BONES = ("head", "leftEye", "rightEye")
# in the order of Unreal's EARFaceBlendShape
NAMES = (
    *(f"eye{motion}{side}" for side in ("Left", "Right") for motion in _EYE),
    *("jawForward", "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker"),
    *("mouthLeft", "mouthRight", "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft"),
    *("mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft"),
    *("mouthStretchRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower"),
    *("mouthShrugUpper", "mouthPressLeft", "mouthPressRight", "mouthLowerDownLeft"),
    *("mouthLowerDownRight", "mouthUpperUpLeft", "mouthUpperUpRight", "browDownLeft"),
    *("browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff"),
    *("cheekSquintLeft", "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut"),
    *(f"{bone}{angle}" for bone in _BONES for angle in ("Yaw", "Pitch", "Roll")),
)

_LENGTH = struct.Struct(">i")
_TIME = struct.Struct(">ifiiB")


def read_packet(data: bytes) -> Timed | None:
    """Return the frame of a packet, None for one that the app sends while it sees no face.

    Raises :class:`PacketError` for anything else.
    """
    if not data or data[0] != VERSION:
        raise PacketError("this is no packet of Live Link Face, version 6")
    place = _skip_name(data, 1)  # the device's
    place = _skip_name(data, place)  # the subject's
    try:
        frame, beyond, numerator, denominator, count = _TIME.unpack_from(data, place)
    except struct.error as error:
        raise PacketError("the packet ends early") from error
    place += _TIME.size
    if count == 0 and place == len(data):
        return None
    if count != len(NAMES) or len(data) != place + 4 * count:
        raise PacketError(f"{len(NAMES)} values are expected, not {count}")
    rate = numerator / denominator if denominator > 0 else 0.0
    if not (LEAST_RATE <= rate <= MOST_RATE and isfinite(beyond)):
        raise PacketError(f"{numerator} / {denominator} is no rate of frames")
    values = struct.unpack_from(f">{count}f", data, place)
    if not all(abs(value) <= MOST for value in values):  # NaN is not
        raise PacketError("a value is no weight and no angle")
    return Timed((frame + beyond) / rate, dict(zip(NAMES, values, strict=True)))


def _skip_name(data: bytes, place: int) -> int:
    """Return where a name ends; one that is too long or goes beyond the packet is refused."""
    if len(data) < place + _LENGTH.size:
        raise PacketError("the packet ends early")
    (length,) = _LENGTH.unpack_from(data, place)
    end: int = place + _LENGTH.size + length
    if not 0 <= length <= LONGEST_NAME or end > len(data):
        raise PacketError(f"a name has {length} bytes")
    return end
