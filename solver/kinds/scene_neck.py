"""The neck that carries the head of a scene."""

from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from solver.kinds.document import Document, Place, Time


class HeadPush(Document):
    """A push on the skull, for a while."""

    time: Time
    seconds: float = Field(default=0.1, ge=0.001, le=60, description="how long it lasts")
    at: Place
    newtons: list[Annotated[float, Field(ge=-500, le=500)]] = Field(
        min_length=3, max_length=3, description="to the torso's left, up, and forward"
    )


class NeckEntry(Document):
    """A neck that carries the head: seven vertebrae and the skull on a torso that stands still.

    The turns of ``head``, of a take or a recording are its goal; moves of the head are out of its
    reach.
    """

    asset: str | None = Field(
        default=None, description="an OpenSim model of a neck; null: the built-in neck"
    )
    muscles: bool = Field(
        default=True,
        description="whether muscles move the vertebrae, as controlled; false: joints share the "
        "head's turn, which is followed as it is",
    )
    skin: bool = Field(
        default=True,
        description="whether the skin of the neck follows the vertebrae, the rim still; false: it "
        "turns with the head, also where a skin ends in no neck",
    )
    coupling: bool = Field(
        default=True,
        description="whether the flesh under the chin is drawn by the neck; false: where it ends "
        "it stays with the head",
    )
    pushes: list[HeadPush] = Field(
        default=[],
        max_length=32,
        description="forces on the head, which muscles withstand; the flesh feels the motion alone",
    )

    @field_validator("pushes")
    @classmethod
    def _has_muscles(cls, value: list[HeadPush], info: ValidationInfo) -> list[HeadPush]:
        if value and info.data.get("muscles") is False:
            message = "needs muscles, which withstand it: without, a neck follows the head as it is"
            raise PydanticCustomError("no_muscles", message)
        return value

    voluntary_hz: float = Field(
        default=25.0, ge=5, le=200, description="rate of the voluntary layer, which plans ahead"
    )
    reflex_hz: float = Field(
        default=4000.0, ge=1000, le=20_000, description="rate of the reflexes, and time steps"
    )
    reflex_strain: float = Field(
        default=10.0, ge=0, le=100, description="activation a strain of 1 beyond what was planned"
    )
    reflex_strain_rate: float = Field(
        default=2.0, ge=0, le=100, description="activation a strain rate of 1/s beyond it"
    )
    reflex_delay_ms: float = Field(
        default=0.0, ge=0, le=100, description="of the reflexes: tens of ms in people"
    )
    cocontraction: float = Field(
        default=0.0, ge=0, le=0.5, description="activation of all muscles that stiffens the neck"
    )
