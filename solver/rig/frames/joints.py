"""A skin on a chain of joints, as glTF has it: morph targets move it, then joints carry it.

Joint k hangs on joint k - 1, a fixed step away, and turns by a rotation of its own; what each takes
with it is x -> R_k (x - c_k) + p_k, with c_k its place at rest. The first one does not turn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pygltflib as gl
from scipy.spatial.transform import Rotation, Slerp

from solver.rig.frames.gltf import Tracks, steady_side
from solver.rig.frames.gltf_buffer import METRES, Buffer
from solver.rig.frames.skin_basis import Singles
from solver.surface import Floats, Ints

MOST = 4  # joints a vertex, which glTF has numbers and weights of


@dataclass(frozen=True, eq=False)
class Joints:
    """Joints over the f frames of an animation, and the skin that they carry; lengths in mm."""

    names: tuple[str, ...]  # (k,)
    rest: Floats  # (k, 3) places at rest
    turns: Floats  # (f, k, 3) rotation vectors of each against the one before, rad
    bones: Ints  # (v, 2) the joints that carry a vertex
    weights: Floats  # (v, 2) how much, summing to 1
    unposed: Singles  # (f, v, 3) the skin that they carry

    @property
    def nodes(self) -> list[gl.Node]:
        """Return a node of each joint, as in the first frame."""
        steps = np.diff(self.rest, axis=0, prepend=np.zeros((1, 3))) * METRES
        turns = Rotation.from_rotvec(self.turns[0]).as_quat()
        return [
            gl.Node(name=name, translation=step.tolist(), rotation=turn.tolist())
            for name, step, turn in zip(self.names, steps, turns, strict=True)
        ]

    def attributes(self, buffer: Buffer) -> dict[str, int]:
        """Add each vertex's joints and weights, and return their accessors by attribute."""
        others = ((0, 0), (0, MOST - self.bones.shape[1]))
        shares = np.pad(self.weights, others)
        table = np.where(shares > 0.0, np.pad(self.bones, others), 0)  # as glTF asks for
        return {
            "JOINTS_0": buffer.joints(table),
            "WEIGHTS_0": buffer.dense(shares, gl.VEC4, gl.ARRAY_BUFFER),
        }

    def skin(self, buffer: Buffer, first: int) -> gl.Skin:
        """Add what takes the rest to each joint; ``first`` is the number of the first's node."""
        return gl.Skin(
            name="neck",
            skeleton=first,
            joints=list(range(first, first + len(self.names))),
            inverseBindMatrices=buffer.bindings(self.rest),
        )

    def tracks(self, buffer: Buffer, times: Floats, keys: Ints) -> list[Tracks]:
        """Add the turns at the frames ``keys`` (n,) of ``times`` (f,), for the nodes' animation."""
        at_keys = buffer.dense(times[keys], gl.SCALAR, bounds=True)
        found: list[Tracks] = [{}]
        for number in range(1, len(self.names)):
            turns = steady_side(Rotation.from_rotvec(self.turns[keys, number]).as_quat())
            found.append({gl.ROTATION: (at_keys, buffer.dense(turns, gl.VEC4))})
        return found

    def error(self, skin: Floats, times: Floats, first: int, last: int, frames: Ints) -> Floats:
        """Return how far ``frames`` (n,) are off, mm, where ``first`` and ``last`` alone are keys.

        At most so far, of any point within the box of the ``skin`` (v, 3).
        """
        box = np.array([skin.min(axis=0), skin.max(axis=0)])
        corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
        wanted = self._corners(Rotation.from_rotvec(self.turns[frames].reshape(-1, 3)), corners)
        steady = []
        straight = []
        ends = times[[first, last]]
        now = times[frames]
        part = ((now - ends[0]) / (ends[1] - ends[0]))[:, None]
        for number in range(len(self.names)):
            turns = Rotation.from_rotvec(self.turns[[first, last], number])
            steady.append(Slerp(ends, turns)(now).as_quat())
            begin, end = steady_side(turns.as_quat())
            straight.append((1.0 - part) * begin + part * end)
        # by glTF they turn steadily, Blender draws quaternions' entries as lines: both count
        off = [
            np.linalg.norm(
                self._corners(Rotation.from_quat(np.stack(way, axis=1).reshape(-1, 4)), corners)
                - wanted,
                axis=-1,
            )
            for way in (steady, straight)
        ]
        return np.asarray(np.max(off, axis=(0, 2, 3)))

    def _corners(self, turns: Rotation, corners: Floats) -> Floats:
        matrices = chain(self.rest, turns.as_matrix().reshape(-1, len(self.names), 3, 3))
        placed = np.einsum("fkij,cj->fkci", matrices[..., :3, :3], corners)
        return np.asarray(placed + matrices[..., None, :3, 3])


def chain(rest: Floats, turns: Floats) -> Floats:
    """Return what takes rest points along with each joint, (f, k, 4, 4), by ``turns`` (f, k, 3, 3).

    ``rest`` (k, 3) are the joints' places at rest.
    """
    made = np.tile(np.eye(4), (*turns.shape[:2], 1, 1))
    turned = np.tile(np.eye(3), (len(turns), 1, 1))
    place = np.zeros((len(turns), 3))
    for joint, step in enumerate(np.diff(rest, axis=0, prepend=np.zeros((1, 3)))):
        place = place + turned @ step
        turned = turned @ turns[:, joint]
        made[:, joint, :3, :3] = turned
        made[:, joint, :3, 3] = place - turned @ rest[joint]
    return made


@dataclass(frozen=True)
class ReadJoints:
    """Joints as a file has them: ``turns`` are times (n,) and quaternions (n, 4) by joint."""

    rest: Floats  # (k, 3) mm
    bones: np.ndarray  # (v, 4)
    weights: np.ndarray  # (v, 4)
    turns: Mapping[int, tuple[Floats, np.ndarray]]

    def carry(self, skins: Floats, times: Floats) -> Floats:
        """Return ``skins`` (f, v, 3) at ``times`` (f,) as the joints carry them, mm."""
        turns = np.tile(np.eye(3), (len(times), len(self.rest), 1, 1))
        for joint, (keys, quaternions) in self.turns.items():
            turns[:, joint] = turn_between(keys, quaternions, times)
        matrices = chain(self.rest, turns)
        placed = np.zeros(skins.shape)
        for bone, weight in zip(self.bones.T, self.weights.T, strict=True):
            if not weight.any():
                continue
            chosen = matrices[:, bone]
            moved = np.einsum("fvij,fvj->fvi", chosen[..., :3, :3], skins)
            placed += weight[:, None] * (moved + chosen[..., :3, 3])
        return placed


def turn_between(keys: Floats, quaternions: np.ndarray, times: Floats) -> Floats:
    """Return rotations (f, 3, 3) at ``times``, steady between keys (k,), of (x, y, z, w) (k, 4)."""
    turns = Rotation.from_quat(quaternions.astype(np.float64))
    if len(keys) == 1:
        return np.repeat(turns.as_matrix(), len(times), axis=0)
    return np.asarray(Slerp(keys, turns)(np.clip(times, keys[0], keys[-1])).as_matrix())


def read_joints(
    document: Mapping[str, Any], skin: Mapping[str, Any], values: Any, part: Mapping[str, Any]
) -> ReadJoints:
    """Return a file's joints: its ``skin``, ``values`` of accessors, and a ``part`` of its mesh."""
    numbers: Sequence[int] = skin["joints"]
    back = values(skin["inverseBindMatrices"]).reshape(-1, 4, 4)
    turns = {}
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            target = channel["target"]
            if target["node"] in numbers and target["path"] == "rotation":
                sampler = animation["samplers"][channel["sampler"]]
                keys = values(sampler["input"])[:, 0].astype(np.float64)
                turns[numbers.index(target["node"])] = keys, values(sampler["output"])
    attributes = part["attributes"]
    return ReadJoints(
        -back[:, 3, :3].astype(np.float64) / METRES,
        values(attributes["JOINTS_0"]).astype(np.int64),
        values(attributes["WEIGHTS_0"]),
        turns,
    )
