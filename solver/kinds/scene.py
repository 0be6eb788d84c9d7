"""Scenes: what is simulated, animated or edited of a person, as JSON documents.

Lengths are in mm, times in s, stress in Pa; x is to the subject's left, y up, z forward.
"""

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from solver.kinds.document import (
    Document,
    FrameNumber,
    Integral,
    Name,
    Place,
    Time,
    Vector,
    Whole,
    by_member,
    by_type,
    find_kind,
    tell_forms,
)
from solver.kinds.scene_edits import Edits
from solver.kinds.scene_neck import NeckEntry
from solver.kinds.scene_recording import Gain, Recording

MOST_TRACK_KEYS = 10000  # of one track of a scene
STIFFNESS_PA = 3000.0  # mu of facial soft tissue: a Young's modulus of 7.5 kPa, 8.6 by other laws

Turn = Annotated[
    list[Annotated[float, Field(ge=-3600, le=3600)]],
    Field(
        min_length=3,
        max_length=3,
        description="a rotation vector in degrees: its length is the angle, about its direction",
    ),
]


class MaterialEntry(Document):
    """Material of the flesh."""

    law: Literal["corotated_trace", "corotated_det", "neo_hookean", "mooney_rivlin"] = Field(
        default="corotated_trace", description="corotated_trace is what rigs are fitted with"
    )
    stiffness_pa: float = Field(
        default=STIFFNESS_PA,
        ge=10,
        le=10_000_000,
        description="shear modulus mu; a third of Young's modulus, about",
    )


class ContactEntry(Document):
    """Contacts of the skin."""

    lips: bool = Field(default=True, description="lips with lips")
    teeth: bool = Field(default=True, description="lips with teeth")
    eyes: bool = Field(default=True, description="lids with eyeballs")
    friction: float = Field(
        default=0.0, ge=0, le=5, description="coefficient, of skin on skin and on objects"
    )


class FleshEntry(Document):
    """Flesh and contact, in every scene."""

    material: MaterialEntry = Field(default_factory=MaterialEntry)
    activation_model: Literal["blended", "fibre"] = Field(
        default="blended",
        description="blended: six numbers a muscle, as fitted; fibre: contraction along fibres "
        "only",
    )
    sliding: bool = Field(
        default=True, description="whether skin slides on the skull, or is pinned to it"
    )
    contact: ContactEntry = Field(default_factory=ContactEntry)


class Jaw(Document):
    """The jaw's pose, on top of the expressions'."""

    open_deg: float = Field(default=0.0, ge=-360, le=360)
    left_deg: float = Field(default=0.0, ge=-360, le=360, description="to the subject's left")
    move_mm: Vector = Field(
        default_factory=lambda: [0.0, 0.0, 0.0],
        description="to the subject's left, up, and forward",
    )


Muscle = Annotated[
    Annotated[float, Field(ge=0.3, le=1.5), Tag("<stretch>")]
    | Annotated[
        list[Annotated[float, Field(ge=-10, le=10)]],
        Field(min_length=6, max_length=6),
        Tag("<activation>"),
    ],
    tell_forms(
        by_type({int: "<stretch>", float: "<stretch>", list: "<activation>"}),
        "is not a number or a list of six",
    ),
]


class Keyframe(Document):
    """The face at one time."""

    time: Time
    expressions: dict[str, Annotated[float, Field(ge=0, le=1)]] = Field(
        default_factory=dict, max_length=256, description="weights of the rig's expressions by name"
    )
    muscles: dict[str, Muscle] = Field(
        default_factory=dict,
        max_length=256,
        description="by name, on top of the expressions: the length of the fibres over that at "
        "rest, or the six numbers xx, xy, xz, yy, yz, zz of an activation",
    )
    jaw: Jaw = Field(default_factory=Jaw)
    fibres: dict[str, Annotated[float, Field(ge=-1, le=1)]] = Field(
        default_factory=dict,
        max_length=256,
        description="activations of fibre muscles by name, on top of what is performed",
    )
    shapes: dict[str, Annotated[float, Field(ge=0, le=1)]] = Field(
        default_factory=dict,
        max_length=256,
        description="weights of the shapes of tracks by name, in a scene that these drive",
    )


class MotionKey(Document):
    """A turn and a move at one time."""

    time: Time
    rotation_deg: Turn = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    move_mm: Vector = Field(default_factory=lambda: [0.0, 0.0, 0.0])


class FrameSpan(Document):
    """Frames of a take, from ``start`` to before ``end``."""

    start: FrameNumber
    end: FrameNumber


class Bridges(Document):
    """Frames that are blended over, from the one before them to the one after."""

    missing: bool = Field(
        default=True,
        description="frames without data, that the fit kept, did not see or predicted; false: "
        "these are played as they are",
    )
    spans: list[FrameSpan] = Field(
        default=[], max_length=1000, description="others, by their numbers in the sequence"
    )


class PerformanceEntry(Document):
    """A fitted performance, played by the flesh."""

    asset: str = Field(description="the sequence.npz of a fit to a performance")
    start: FrameNumber | None = Field(
        default=None, description="the first frame, by its number in the sequence; null: its first"
    )
    end: FrameNumber | None = Field(
        default=None, description="the frame after the last; null: to the end"
    )
    speed: float = Field(default=1.0, ge=0.01, le=100, description="2 plays it twice as fast")
    gain: Gain = Field(
        default=1.0,
        description="of all activations, S to this power: 0 is rest, 1 as fitted, above it "
        "exaggerates, with stretches from 0.1 to 10; those of fibre muscles times it, up to 1, "
        "weights of shapes times it; the jaw and the head stay as they are",
    )
    muscles: dict[str, Gain] = Field(
        default={}, max_length=256, description="gains of muscles by name, times that of all"
    )
    curve: dict[str, Gain] = Field(
        default={},
        max_length=256,
        description="factors on the force-length curves of fibre muscles, by name, beyond what an "
        "activation of 1 does",
    )
    mask: list[str] | None = Field(
        default=None,
        min_length=1,
        max_length=256,
        description="the muscles that it moves; null: all that no other performance's mask names",
    )
    head: Literal["from_start", "as_fitted", "still"] = Field(
        default="from_start",
        description="the head's motion from where it is in the first frame, or as it was fitted, "
        "in the studio; or none",
    )
    keys: list[Keyframe] = Field(
        default=[],
        max_length=MOST_TRACK_KEYS,
        description="what is added to it, at times of the scene",
    )
    bridges: Bridges = Field(default_factory=Bridges)


Performances = Annotated[
    Annotated[PerformanceEntry, Tag("<one>")]
    | Annotated[list[PerformanceEntry], Field(min_length=1, max_length=8), Tag("<several>")],
    tell_forms(
        by_type({dict: "<one>", PerformanceEntry: "<one>", list: "<several>"}),
        "is not null, a performance or a list of them",
    ),
]


class GravityEntry(Document):
    """Weight, less that under which the neutral was scanned."""

    kind: Literal["gravity"]
    mm_s2: Vector = Field(default=[0.0, -9810.0, 0.0])


class WindEntry(Document):
    """Wind on the skin."""

    kind: Literal["wind"]
    m_s: list[Annotated[float, Field(ge=-200, le=200)]] = Field(min_length=3, max_length=3)
    gusts: float = Field(default=0.0, ge=0, le=1, description="the part of it that comes and goes")
    seed: Whole = Field(default=0, ge=0, description="of the gusts")


class PullEntry(Document):
    """A pull at a point of the skin."""

    kind: Literal["point"]
    at: Place
    mn: Vector = Field(description="millinewtons, in the head's frame")
    radius_mm: float = Field(default=5.0, ge=0.001, le=100)
    ramp: float = Field(
        default=0.0, ge=0, le=600, description="seconds from 0 on in which it grows"
    )


Force = Annotated[
    Annotated[GravityEntry, Tag("<gravity>")]
    | Annotated[WindEntry, Tag("<wind>")]
    | Annotated[PullEntry, Tag("<point>")],
    Discriminator(find_kind),
]


class AssetMesh(Document):
    """A mesh of a file."""

    asset: str = Field(
        description="OBJ, PLY or STL in mm, or GLB in metres, in the subject's frame"
    )


class Box(Document):
    """A box."""

    box_mm: list[Annotated[float, Field(ge=0.001, le=1000)]] = Field(min_length=3, max_length=3)


class Ball(Document):
    """A ball."""

    ball_mm: float = Field(ge=0.001, le=500, description="its radius")


class Rod(Document):
    """A round rod."""

    rod_mm: list[Annotated[float, Field(ge=0.01, le=500)]] = Field(
        min_length=2,
        max_length=2,
        description="its radius, and its length along z without its round ends",
    )


class Object(Document):
    """A closed mesh that meets the face."""

    name: Name
    mesh: Annotated[
        Annotated[AssetMesh, Tag("<asset>")]
        | Annotated[Box, Tag("<box_mm>")]
        | Annotated[Ball, Tag("<ball_mm>")]
        | Annotated[Rod, Tag("<rod_mm>")],
        tell_forms(
            by_member("asset", "box_mm", "ball_mm", "rod_mm"),
            "is not an object with asset, box_mm, ball_mm or rod_mm",
        ),
    ]
    at: Place = Field(
        default_factory=lambda: [0.0, 0.0, 0.0],
        description="where the mesh's origin is put, in the world",
    )
    path: list[MotionKey] = Field(
        default=[],
        max_length=MOST_TRACK_KEYS,
        description="turns about its origin, and moves from where it was put",
    )


# Scenes of each kind of job.


class PlayedScene(FleshEntry):
    """A scene with frames: of a simulation or an animation."""

    drive: Literal["muscles", "tracks"] = Field(
        default="muscles",
        description="what moves the flesh: muscles, as the rig was fitted; tracks, the shapes of "
        "build_tracks, with its law of the flesh unless the scene gives another",
    )
    mode: Literal["quasi_static", "dynamic"] = Field(
        default="quasi_static",
        description="dynamic: the flesh has inertia; quasi_static: every frame is an equilibrium",
    )
    steps_per_frame: Annotated[int, Field(ge=1, le=64), Integral] | None = Field(
        default=None, description="null: 4 if dynamic, else 1; long steps damp what swings"
    )
    damping: float = Field(
        default=0.5,
        ge=0,
        le=1000,
        description="of a dynamic face's motion in its head, per mass, in 1/s",
    )
    head: list[MotionKey] = Field(
        default=[],
        max_length=MOST_TRACK_KEYS,
        description="where the head is; it turns about the neck",
    )
    neck: NeckEntry | None = Field(
        default=None,
        description="a neck that carries the head; null: the whole head turns about one point, "
        "its neck with it",
    )
    forces: list[Force] = Field(default=[], max_length=32)
    objects: list[Object] = Field(
        default=[],
        max_length=16,
        description="closed meshes that meet the face, moving on given paths",
    )
    edits: Edits = Field(default=[])


class SimulateScene(PlayedScene):
    """Fitted performances, and keys of expressions, muscles and jaw, played by the flesh."""

    fps: float = Field(default=30.0, ge=1, le=240, description="frames per second")
    duration: Annotated[float, Field(ge=0, le=600)] | None = Field(
        default=None, description="in seconds, from 0; null: as long as the keys and performances"
    )
    interpolation: Literal["smooth", "linear"] = Field(
        default="smooth",
        description="between keys, those of head and objects too, and between a performance's "
        "frames; smooth never goes beyond them",
    )
    performance: Performances | None = Field(
        default=None,
        description="fitted performances: the muscles are mixed by their masks, jaw and head are "
        "the first one's",
    )
    keys: list[Keyframe] = Field(
        default=[],
        max_length=MOST_TRACK_KEYS,
        description="what the face does, on top of its performances; what a key does not name is "
        "at rest there, or as performed",
    )


class AnimateScene(PlayedScene):
    """A recording of Live Link Face or OpenFace, played by the flesh."""

    recording: Recording
    controls: Literal["learned", "blended", "exact"] | None = Field(
        default=None,
        description="what a frame's weights make the muscles do: learned, by controls.npz of "
        "learn_controls; blended, by adding up what makes each shape alone; exact, fitted frame "
        "after frame; null: learned where the rig has controls, else blended",
    )
    exact_above_mm: float = Field(
        default=0.3,
        ge=0,
        le=100,
        description="doubt of learned controls, mm on the skin, above which a frame is fitted "
        "exactly",
    )
    lids: bool = Field(
        default=True,
        description="lids go where the recorded shapes of an eye take them, as muscles leave a "
        "gap; false: where the flesh has them",
    )


class EditScene(FleshEntry):
    """Edits of a person's anatomy."""

    edits: Edits
