"""What is told of a photograph's sharpness, exposure and closed eyes."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from solver.photo.facts import IBUG_MEDIAPIPE
from solver.photo.oddities import find_closed_eyes, find_oddities
from solver.photo.photo import Photo

# a face of 200 x 220 px, its outer corners of the eyes 120 px apart
MARKS = {"33": (90, 120), "263": (210, 120), "10": (150, 40), "152": (150, 260)}
SIDE = 300


def textured(scale: int = 1) -> Photo:
    """Return a face of noise that has as much detail at all sizes, in a picture of 300 px."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(SIDE), np.fft.rfftfreq(SIDE), indexing="ij"))
    noise = np.fft.rfft2(np.random.default_rng(0).normal(size=(SIDE, SIDE)))
    grey = np.fft.irfft2(noise / np.maximum(frequency, 1 / SIDE), (SIDE, SIDE))
    grey = np.clip(0.5 + 0.1 * grey / grey.std(), 0.1, 0.9)
    pixels = np.repeat(grey[..., None], 3, axis=2).astype(np.float32)
    pixels = pixels.repeat(scale, axis=0).repeat(scale, axis=1)
    return Photo(
        "anna", pixels, landmarks={name: scale * np.array(at, float) for name, at in MARKS.items()}
    )


def codes(photo: Photo) -> list[str]:
    return [finding.code for finding in find_oddities(photo)]


def blurred(photo: Photo, share: float) -> Photo:
    """Return a photograph blurred by a share of the distance of the eyes."""
    assert photo.eyes_px is not None
    px = share * photo.eyes_px
    return replace(photo, pixels=gaussian_filter(photo.pixels, (px, px, 0.0)))


@pytest.mark.parametrize("scale", [1, 3])
def test_a_sharp_face_is_not_odd_and_a_blurred_one_is_at_any_size(scale: int) -> None:
    photo = textured(scale)
    assert codes(photo) == []
    assert codes(blurred(photo, 0.01)) == []
    assert codes(blurred(photo, 0.04)) == ["photo.blurred"]
    low_contrast = replace(photo, pixels=0.4 + 0.1 * photo.pixels)
    assert codes(low_contrast) == []


def test_named_corners_of_the_eyes_do_as_well_and_without_them_nothing_is_told() -> None:
    photo = blurred(textured(), 0.04)
    names = {"33": "exocanthion_r", "263": "exocanthion_l"}
    named = {names.get(name, name): place for name, place in photo.landmarks.items()}
    assert codes(replace(photo, landmarks=named)) == ["photo.blurred"]
    unknown = {name: place for name, place in named.items() if name != "exocanthion_l"}
    assert codes(replace(photo, landmarks=unknown)) == []


@pytest.mark.parametrize("places", [[], [(20, 20), (90, 90), (50, 50)], [(-90, -90), (-20, -40)]])
def test_landmarks_that_are_no_face_are_left_alone(places: list[tuple[int, int]]) -> None:
    marks = {str(number): np.array(place, float) for number, place in enumerate(places)}
    assert codes(replace(textured(), landmarks=marks)) == []


def test_memory_does_not_grow_with_the_picture() -> None:
    photo = textured(scale=8)
    tracemalloc.start()
    assert codes(photo) == []
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert photo.pixels.nbytes > 60e6
    assert peak < 10e6


def test_exposure_is_told_of_the_face_alone() -> None:
    photo = textured()
    around = photo.pixels.copy()
    within = photo.pixels.copy()
    around[:35] = around[265:] = 1.0
    within[40:150] = 1.0
    assert codes(replace(photo, pixels=around)) == []
    assert "photo.exposure" in codes(replace(photo, pixels=within))
    dark = replace(photo, pixels=photo.pixels * np.where(within == 1.0, 0.0, 1.0))
    assert "photo.exposure" in codes(dark)
    assert "photo.exposure" not in codes(replace(dark, mask=within[..., 0] < 1.0))


def test_eyes_are_closed_only_where_both_are() -> None:
    """The 68 points have the same places on lids as MediaPipe's mesh."""

    def lids(right: float, left: float) -> dict[str, np.ndarray]:
        marks = {}
        for start, names, height in (
            (0, ("33", "160", "158", "133", "153", "144"), right),
            (60, ("362", "385", "387", "263", "373", "380"), left),
        ):
            across = (0, 10, 20, 30, 20, 10)
            down = (0.0, 0.0, 0.0, 0.0, height, height)
            marks |= dict(zip(names, zip(np.add(start, across), down, strict=True), strict=True))
        assert marks.keys() <= set(IBUG_MEDIAPIPE.values())
        return {name: np.array(at) for name, at in marks.items()}

    assert [each.code for each in find_closed_eyes("anna", lids(1, 2))] == ["photo.eyes_closed"]
    assert not [*find_closed_eyes("anna", lids(1, 10))]
    assert not [*find_closed_eyes("anna", textured().landmarks)]
