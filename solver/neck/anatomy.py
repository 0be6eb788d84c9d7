"""The anatomy of a neck: nine bodies on eight ball joints, discs, muscles, and a pose of them.

Axes are the house's: x to the subject's left, y up, z forward; the origin is the joint of the head
(occiput and C1) of the neck at rest, in which the head is upright. Rotations about x nod (positive
looks down), about y turn (positive to the left), about z tilt (positive towards the right
shoulder). Lengths are mm, masses kg, angles rad; stiffness is N m/rad.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from solver.similarity import Similarity, move_each
from solver.surface import Floats, Ints

# bottom to top; the first does not move
BODIES = ("torso", "C7", "C6", "C5", "C4", "C3", "C2", "C1", "head")
JOINTS = len(BODIES) - 1  # joint k is at the bottom of body k + 1
MM = 1e-3  # m


@dataclass(frozen=True)
class NeckMuscle:
    """A muscle along straight lines through points that bodies carry."""

    name: str
    bodies: Ints  # (k,) numbers in BODIES
    points: Floats  # (k, 3) mm at rest
    strength: float  # N, at full activation and optimal length
    fibre: float  # mm, optimal length
    tendon: float  # mm, slack length; it does not stretch
    pennation: float = 0.0  # rad, at the optimal length
    source: str = ""  # where its numbers are from

    @property
    def length(self) -> float:
        """Return the length of the path at rest in mm."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


@dataclass(frozen=True)
class Neck:
    """A neck at rest."""

    centres: Floats  # (8, 3) mm, of the joints under C7 ... C1 and the head, which is the origin
    masses: Floats  # (8,) kg, of C7 ... head
    mass_centres: Floats  # (8, 3) mm
    inertias: Floats  # (8, 3, 3) kg m^2, about the mass centres
    stiffness: Floats  # (8, 3) N m/rad, of the discs about x, y, z
    damping: Floats  # (8, 3) N m s/rad
    ranges: Floats  # (8, 3) rad, how far each joint turns about x, y, z to either side
    shares: Floats  # (8, 3) of the head's rotation that each joint takes; columns sum to 1
    muscles: tuple[NeckMuscle, ...]
    source: str  # a file's name, or what the built-in table is from
    landmarks: Mapping[str, Floats] = field(default_factory=dict)  # of the skull, (3,) mm each
    notices: tuple[str, ...] = ()  # what was replaced or left out as it was read
    ligaments: float = 2000.0  # N m/rad, of a joint 0.1 rad beyond where they are slack
    slack: float = 0.9  # part of a joint's range in which ligaments are

    @property
    def head_range(self) -> Floats:
        """Return how far the head turns about x, y, z (3,) to either side in rad."""
        return np.asarray(self.ranges.sum(axis=0))

    def moved(self, placed: Similarity) -> Neck:
        """Return the neck under a person: scaled, turned and shifted as a whole.

        Masses go with the scale's cube, inertias with its fifth power, strengths and stiffness
        with its square and cube, as do areas and volumes.
        """
        s = placed.scale
        R = placed.rotation
        muscles = tuple(
            replace(
                each,
                points=placed(each.points),
                strength=each.strength * s**2,
                fibre=each.fibre * s,
                tendon=each.tendon * s,
            )
            for each in self.muscles
        )
        return replace(
            self,
            centres=placed(self.centres),
            masses=self.masses * s**3,
            mass_centres=placed(self.mass_centres),
            inertias=np.asarray(R @ self.inertias @ R.T * s**5),
            stiffness=self.stiffness * s**3,
            damping=self.damping * s**3,
            ligaments=self.ligaments * s**3,
            muscles=muscles,
            landmarks={
                name: placed(np.atleast_2d(each))[0] for name, each in self.landmarks.items()
            },
        )

    def pose(self, turns: Floats) -> NeckPose:
        """Return the pose in which each joint turns by a rotation vector of ``turns`` (8, 3).

        Each is that of the body above a joint against the body under it, in the axes of the latter.
        """
        rotations = np.empty((JOINTS, 3, 3))
        places = np.empty((JOINTS, 3))
        turned = np.eye(3)
        place = self.centres[0]
        for joint, step in enumerate(Rotation.from_rotvec(turns).as_matrix()):
            if joint:
                place = place + turned @ (self.centres[joint] - self.centres[joint - 1])
            turned = turned @ step
            rotations[joint] = turned
            places[joint] = place
        return NeckPose(self.centres, rotations, np.vstack([np.zeros((1, 3)), places]))


@dataclass(frozen=True)
class NeckPose:
    """Where the bodies of a neck are: a rest point p of body k is at R_k (p - c_k) + place_k.

    Body 0, the torso, does not move: its R is 1, its c and place are 0.
    """

    centres: Floats  # (8, 3) mm, of the joints at rest
    rotations: Floats  # (8, 3, 3) of C7 ... head against the torso
    places: Floats  # (9, 3) mm, of the torso's origin and the joints

    @property
    def head(self) -> Floats:
        """Return the head's rotation against the torso (3, 3)."""
        return np.asarray(self.rotations[-1])

    @property
    def turns(self) -> Floats:
        """Return each joint's rotation vector (8, 3), in the axes of the body under it."""
        under = np.concatenate([np.eye(3)[None], self.rotations[:-1]])
        steps = np.swapaxes(under, 1, 2) @ self.rotations
        return np.asarray(Rotation.from_matrix(steps).as_rotvec())

    @property
    def matrices(self) -> Floats:
        """Return what takes rest points of each body to their places, (9, 4, 4) in mm."""
        made = np.tile(np.eye(4), (len(BODIES), 1, 1))
        made[1:, :3, :3] = self.rotations
        made[1:, :3, 3] = self.places[1:] - np.einsum("kij,kj->ki", self.rotations, self.centres)
        return made

    def points(self, bodies: Ints, points: Floats) -> Floats:
        """Return where rest ``points`` (n, 3) of ``bodies`` (n,), numbers in BODIES, are."""
        return move_each(self.matrices[bodies], points)


def ball_inertia(mass: float, density: float) -> float:
    """Return the moment of inertia of a ball, kg m^2, of ``mass`` kg and ``density`` kg/m^3."""
    radius = (3.0 * mass / (4.0 * np.pi * density)) ** (1.0 / 3.0)
    return float(0.4 * mass * radius**2)
