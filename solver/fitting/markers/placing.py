"""Compiled loops over markers: how places follow their triangles, and the head by what was seen.

A frame has some tens of markers and asks for both several times: by arrays it would take longer to
call than to compute.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from solver.scans.markers.places.marker_set import area_normal
from solver.surface import Floats


@nb.njit(cache=True, error_model="numpy")
def rates_over(corners: Floats, weights: Floats, heights: Floats) -> Floats:
    """Return the derivatives (k, 3, 9) of places over triangles (k, 3, 3) by their corners.

    The places are those of :func:`~solver.scans.markers.places.marker_set.places_over`.
    """
    out = np.zeros((len(corners), 3, 9))
    sides = np.empty((2, 3))
    first = sides[0]
    second = sides[1]
    normal = np.empty(3)
    for k in range(len(corners)):
        length = area_normal(corners[k], sides, normal)
        size = heights[k] / length
        for i in range(3):
            normal[i] /= length
        for i in range(3):
            # a row of size (I - n n^T), times the corners' cross products
            a = -size * normal[i] * normal[0]
            b = -size * normal[i] * normal[1]
            c = -size * normal[i] * normal[2]
            if i == 0:
                a += size
            elif i == 1:
                b += size
            else:
                c += size
            out[k, i, 3] = c * second[1] - b * second[2]
            out[k, i, 4] = a * second[2] - c * second[0]
            out[k, i, 5] = b * second[0] - a * second[1]
            out[k, i, 6] = b * first[2] - c * first[1]
            out[k, i, 7] = c * first[0] - a * first[2]
            out[k, i, 8] = a * first[1] - b * first[0]
            for j in range(3):
                out[k, i, j] = -out[k, i, 3 + j] - out[k, i, 6 + j]
            for corner in range(3):
                out[k, i, 3 * corner + i] += weights[k, corner]
    return out


class PlacedHead(NamedTuple):
    """Points after the head's small motion xi = (omega, tau), which is the most probable."""

    xi: Floats  # (6,)
    rotation: Floats  # (3, 3) of omega
    arms: Floats  # (k, 3) of the points off the head's centre, turned
    offsets: Floats  # (k, 3) off what was seen; 0 for what was not
    normal: Floats  # (6, 6) second derivative by a further small motion


@nb.njit(cache=True, error_model="numpy")
def place_head(
    arms: Floats,
    seen: Floats,
    precision: Floats,
    known: Floats,
    xi: Floats,
    steps: int,
    accuracy: float,
) -> PlacedHead:
    """Return the head by Newton's method from a motion ``xi`` (6,).

    Points are ``arms`` (k, 3) off the head's centre before, and ``seen`` (k, 3) off it, with a
    ``precision`` (k, 3); where that is 0 nothing was seen. ``known`` (6, 6) is the precision of xi.
    A step whose numbers are all within ``accuracy`` is not taken.
    """
    quaternion = _quaternion(xi[0], xi[1], xi[2])
    xi = xi.copy()
    now = _turned(arms, seen, precision, known, xi, quaternion)
    for _ in range(steps):
        step = -np.linalg.solve(now.normal, _slope(now, precision) + known @ xi)
        if np.abs(step).max() < accuracy:
            break
        # a further rotation, composed; it is small
        quaternion = _composed(_quaternion(step[0], step[1], step[2]), quaternion)
        xi[0], xi[1], xi[2] = _rotation_vector(quaternion)
        xi[3:] += step[3:]
        now = _turned(arms, seen, precision, known, xi, quaternion)
    return now


Quaternion = tuple[float, float, float, float]


@nb.njit(cache=True, error_model="numpy")
def _turned(
    arms: Floats, seen: Floats, precision: Floats, known: Floats, xi: Floats, quaternion: Quaternion
) -> PlacedHead:
    """Return points after a motion xi (6,), whose rotation is the ``quaternion``."""
    x, y, z, w = quaternion
    rotation = np.empty((3, 3))
    rotation[0] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
    rotation[1] = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
    rotation[2] = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)
    turned = np.empty_like(arms)
    offsets = np.zeros_like(arms)
    normal = known.copy()
    for k in range(len(arms)):
        for i in range(3):
            turned[k, i] = 0.0
            for j in range(3):
                turned[k, i] += rotation[i, j] * arms[k, j]
            if precision[k, i] > 0.0:
                offsets[k, i] = turned[k, i] + xi[3 + i] - seen[k, i]
        a, b, c = turned[k, 0], turned[k, 1], turned[k, 2]
        p, q, r = precision[k, 0], precision[k, 1], precision[k, 2]
        # of rows (omega x arm + tau)
        normal[0, 0] += q * c * c + r * b * b
        normal[1, 1] += p * c * c + r * a * a
        normal[2, 2] += p * b * b + q * a * a
        normal[0, 1] -= r * a * b
        normal[0, 2] -= q * a * c
        normal[1, 2] -= p * b * c
        normal[0, 4] -= q * c
        normal[0, 5] += r * b
        normal[1, 3] += p * c
        normal[1, 5] -= r * a
        normal[2, 3] -= p * b
        normal[2, 4] += q * a
        normal[3, 3] += p
        normal[4, 4] += q
        normal[5, 5] += r
    for i in range(6):
        for j in range(i):
            normal[i, j] = normal[j, i]
    return PlacedHead(xi, rotation, turned, offsets, normal)


@nb.njit(cache=True, error_model="numpy")
def _slope(now: PlacedHead, precision: Floats) -> Floats:
    """Return the derivative (6,) of half the weighted squares of the offsets."""
    out = np.zeros(6)
    for k in range(len(precision)):
        x, y, z = now.arms[k]
        p = precision[k, 0] * now.offsets[k, 0]
        q = precision[k, 1] * now.offsets[k, 1]
        r = precision[k, 2] * now.offsets[k, 2]
        out[0] += y * r - z * q
        out[1] += z * p - x * r
        out[2] += x * q - y * p
        out[3] += p
        out[4] += q
        out[5] += r
    return out


@nb.njit(cache=True, error_model="numpy")
def _quaternion(x: float, y: float, z: float) -> Quaternion:
    """Return the rotation of a rotation vector as a quaternion, the real part last."""
    angle = math.sqrt(x * x + y * y + z * z)
    size = math.sin(0.5 * angle) / angle if angle > 1e-6 else 0.5 - angle * angle / 48.0
    return size * x, size * y, size * z, math.cos(0.5 * angle)


@nb.njit(cache=True, error_model="numpy")
def _composed(after: Quaternion, before: Quaternion) -> Quaternion:
    """Return the product of two rotations."""
    x, y, z, w = after
    a, b, c, d = before
    found = (
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
        w * d - x * a - y * b - z * c,
    )
    size = 1.0 / math.sqrt(found[0] ** 2 + found[1] ** 2 + found[2] ** 2 + found[3] ** 2)
    return size * found[0], size * found[1], size * found[2], size * found[3]


@nb.njit(cache=True, error_model="numpy")
def _rotation_vector(quaternion: Quaternion) -> tuple[float, float, float]:
    x, y, z, w = quaternion
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    sine = math.sqrt(x * x + y * y + z * z)
    size = 2.0 * math.atan2(sine, w) / sine if sine > 1e-9 else 2.0
    return size * x, size * y, size * z
