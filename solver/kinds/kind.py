"""The contract of a kind of job: what it may be told, what it reads and what it leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, Tag, ValidationError, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from solver.kinds.document import (
    Document,
    Fault,
    Integral,
    Whole,
    find_faults,
    json_schema,
    tell_forms,
)
from solver.kinds.inputs import FILES, INPUTS

Queue = Literal["ingest", "short", "long", "live"]

BUILTIN_VERTICES = 4866  # of the built-in face's skin, which a registered scan of it has

# Seconds after which a job of a queue is ended: while a person waits, at a desk, over night, on a
# stage
QUEUE_SECONDS: Mapping[Queue, int] = {
    "ingest": 120,
    "short": 3600,
    "long": 24 * 3600,
    "live": 25 * 3600,
}

# Bytes that a job of a queue may leave: pictures and a registered scan, a model, films in frames,
# takes
QUEUE_BYTES: Mapping[Queue, int] = {
    "ingest": 1 << 30,
    "short": 4 << 30,
    "long": 16 << 30,
    "live": 16 << 30,
}


class JobOptions(Document):
    """Base of a kind's options: a field each, with default, bounds and a description."""


class OptionsError(ValueError):
    """Options that a kind of job does not take."""

    def __init__(self, faults: list[Fault]) -> None:
        super().__init__(f"{faults[0].where}: {faults[0].message}")
        self.faults = faults


@dataclass(frozen=True)
class Kind:
    """A kind of job, declared once: ``KIND`` of the module that it is named after.

    The module's docstring is what customers read: the kind's title, and after it what it does.

    reads
        Its inputs. A service looks them up at submission: ``capture`` is one scan as it was
        uploaded, with its landmarks; ``neutral`` and ``captures`` are registered scans, the
        subject's neutral and chosen expressions, ``own_scans`` the same where none need be
        chosen; ``performance`` is one capture of that role,
        ``markers`` a take of them with the session's marker set, if there is one, ``activations``
        a table of what is known of single muscles beside them, if there is one, ``photos`` up to
        sixteen photographs with what is known of each, or a film, ``assets`` any
        number of theirs, ``sequences`` those that fits left and ``signals`` what was
        measured of a video, both named as assets are; ``template`` is
        the subject's, ``model`` its newest, ``rig`` a fitted person, ``any_rig`` one that may be
        left out, ``blendshapes``, ``expression_basis`` and calibrated ``fibre_muscles`` are those
        that an earlier job of the rig left, and ``live_skin``, ``live_samples`` and a
        ``marker_set`` without its take as well; ``live_takes`` what the live session of a take
        sent of it, named as a file of that session; ``tracks`` one of its model, ``texture`` and
        ``normals`` those of the registration of its neutral, ``wrinkles`` those of the
        rig's expressions, or others that are named as assets are.
    asks
        What only a command line asks for: the ``role`` of a capture, which a service knows, and
        the ``start`` of a fit, another rig.
    hands_on
        The files it leaves that later jobs may be told to read, of
        :data:`~solver.kinds.inputs.FILES`.
    frames
        Whether it leaves frames, which can be read while it runs and are gone on with after a stop.
    """

    queue: Queue
    reads: tuple[str, ...]
    leaves: str  # what it makes, in a word: jobs with the same word leave the same files
    report: str = ""  # the JSON file that the job's result shows; not given: leaves.json
    result: str = ""  # the file that a person opens first; not given: the report
    options: type[JobOptions] = JobOptions
    asks: tuple[str, ...] = ()
    folder: str = ""  # that a command line fills by default; not given: leaves
    frames: bool = False
    hands_on: tuple[str, ...] = ()
    # options that make another job of it where they are true, with what it is then
    variants: tuple[tuple[str, Kind], ...] = ()
    seconds: int | None = None  # that it may last, where others of its queue last much longer
    name: str = ""  # the module's, whose docstring has title and description
    title: str = ""
    description: str = ""

    def __post_init__(self) -> None:
        """Refuse a contract that names an input or a file which is not declared."""
        for name in {*self.reads, *self.asks} - INPUTS.keys():
            raise ValueError(f"{self.leaves}: no input is called {name}: {', '.join(INPUTS)} are")
        for name in set(self.hands_on) - FILES.keys():
            raise ValueError(f"{self.leaves}: no file {name} is handed on: {', '.join(FILES)} are")

    def given(self, options: Mapping[str, Any]) -> Kind:
        """Return the kind as ``options`` make it: a fit of photographs that are a film, say."""
        chosen = (kind for option, kind in self.variants if options.get(option) is True)
        return next(chosen, self)

    @property
    def max_seconds(self) -> int:
        """Seconds after which an attempt at it is ended, where an installation sets no others."""
        return self.seconds or QUEUE_SECONDS[self.queue]

    @property
    def max_bytes(self) -> int:
        """Bytes that a job of it may leave; one that leaves more has failed."""
        return QUEUE_BYTES[self.queue]

    @property
    def schema(self) -> dict[str, Any]:
        """The JSON Schema of its options."""
        return json_schema(self.options)

    def read(self, given: Mapping[str, Any]) -> JobOptions:
        """Return options with their defaults; raises :class:`OptionsError` with all faults."""
        try:
            return self.options.model_validate(given)
        except ValidationError as error:
            raise OptionsError(self.explain(error, given)) from error

    def faults(self, given: Mapping[str, Any]) -> list[Fault]:
        """Return what is wrong with options."""
        try:
            self.read(given)
        except OptionsError as error:
            return error.faults
        return []

    def explain(self, error: ValidationError, given: Mapping[str, Any]) -> list[Fault]:
        """Return the faults of options that a reader of them found, by their places.

        Unknown options come first, in words that name the known.
        """
        faults = find_faults(error, given, "options")
        known = ", ".join(self.options.model_fields) or "none"
        message = f"{self.name} has no such option; it has {known}"
        strangers = [fault for fault in faults if fault.unknown and len(fault.path) == 1]
        named = [
            replace(fault, where=f"options.{fault.path[0]}", message=message) for fault in strangers
        ]
        others = [fault for fault in faults if fault not in strangers]
        by_place = attrgetter("where")
        return [*sorted(named, key=by_place), *sorted(others, key=by_place)]


# Options that several kinds share.


Axis = Literal["auto", "x", "-x", "y", "-y", "z", "-z"]
Distance = Literal["point", "plane"]
FACTORISATION = "factorisation of the tangent stiffness; null: the fastest that is installed, in"
LinearSolver = Annotated[
    Literal["rslab", "rslab-single", "cholmod", "superlu", None],
    Field(description=f"{FACTORISATION} single precision"),
]
DoubleSolver = Annotated[
    Literal["rslab", "cholmod", "superlu", None],
    Field(description=f"{FACTORISATION} double precision"),
]


class FitOptions(JobOptions):
    """Options of every fit to scans."""

    distance: Distance = Field(
        default="point",
        description="what is made small: point, the distance to the scan's vertices; plane, its "
        "part along the scan's normals, so that the skin may slide along the scan",
    )


class SequenceOptions(JobOptions):
    """Options of every fit of frames that a file counts from 0."""

    fps: float = Field(default=30.0, ge=0.01, le=1000, description="frames per second")
    start: Whole = Field(default=0, ge=0, description="first frame to fit")
    end: Annotated[int, Field(ge=1), Integral] | None = Field(
        default=None, description="the frame after the last to fit; null: all to the end"
    )
    step: Whole = Field(default=1, ge=1, description="fit every frame, every second ...")


class ExpressionFitOptions(FitOptions):
    """Options of fits of expressions by six numbers a muscle."""

    controls: Literal["admissible", "free"] | None = Field(
        default=None,
        description="what muscles and jaw may do: admissible, only what they can (fibres up to "
        "1.02 of their length, any direction from half to 1.9 of it, the volume within 10 %, "
        "the condyles on their tracks); free, any numbers, as published. If not given: admissible; "
        "for a rig, those of its training expressions; free by ipopt, which knows no bounds",
    )
    plausibility: float = Field(
        default=1.0,
        ge=0,
        le=1,
        allow_inf_nan=False,
        description="how much admissible controls keep to what muscles can: 1, all of it; less, "
        "looser bounds and a skin nearer to the scans; 0, nearly free",
    )

    @field_validator("plausibility")
    @classmethod
    def _has_bounds(cls, value: float, info: ValidationInfo) -> float:
        if value < 1.0 and info.data.get("controls") == "free":
            message = "loosens bounds, which free controls do not have: use admissible ones"
            raise PydanticCustomError("no_bounds", message)
        return value

    solver: Literal["reduced", "ipopt"] = Field(
        default="reduced",
        description="reduced: positions are eliminated, and IPOPT steps in where a fit of "
        "activations fails; ipopt: the full-space reference, minutes for an expression, and the "
        "geometry of small meshes only (tetrahedra times expressions at most 2000)",
    )

    @field_validator("solver")
    @classmethod
    def _keeps_bounds(cls, value: str, info: ValidationInfo) -> str:
        asked = (
            info.data.get("controls") == "admissible" or info.data.get("plausibility", 1.0) < 1.0
        )
        if value == "ipopt" and asked:
            message = "fits free controls only: use reduced for admissible ones"
            raise PydanticCustomError("no_bounds", message)
        return value


class PlayOptions(JobOptions):
    """Options of every scene that is played."""

    video: bool = Field(default=False, description="write a film, animation.mp4, too")
    linear_solver: LinearSolver = None


Box = Annotated[list[Annotated[float, Field(ge=-1e6, le=1e6)]], Field(min_length=4, max_length=4)]

MM_A_UNIT = (1e-6, 1e6)  # least and most
UnitName = Literal["auto", "mm", "cm", "m", "inch", "foot"]


def find_unit(value: Any) -> str | None:
    """Return the tag of a unit; a text that is none is told that numbers are allowed, too."""
    if isinstance(value, str):
        return "<name>" if value in get_args(UnitName) else None
    return "<number>" if type(value) in {int, float} else None


Unit = Annotated[
    Annotated[UnitName, Tag("<name>")]
    | Annotated[float, Field(ge=MM_A_UNIT[0], le=MM_A_UNIT[1]), Tag("<number>")],
    tell_forms(find_unit, "is not auto, mm, cm, m, inch, foot or a number of mm"),
]


class FrameOptions(JobOptions):
    """Unit and axes of a raw scan."""

    unit: Unit = Field(
        default="auto",
        description="unit of the file's coordinates: mm, cm, m, inch, foot or a number, the mm of "
        "a unit; auto: what the format says, else what makes it a head",
    )
    eye_distance_mm: float | None = Field(
        default=None,
        ge=35,
        le=90,
        description="or how far apart the person's pupils are, which gives a scan in any unit its "
        "size; grown-ups have 54 to 74 mm",
    )
    up: Axis = Field(
        default="auto",
        description="the file's axis that points to the top of the head; auto: found",
    )
    forward: Axis = Field(
        default="auto", description="the file's axis that points out of the face; auto: found"
    )

    @field_validator("eye_distance_mm")
    @classmethod
    def _one_size(cls, value: float | None, found: ValidationInfo) -> float | None:
        if value is not None and found.data.get("unit", "auto") != "auto":
            raise PydanticCustomError("two_sizes", "is given beside a unit: give one of the two")
        return value
