"""Keep muscles to what is known of them: contractions by EMG, or as an animator pins them.

    w/2 sum_k ((c_k(a) - value_k) / sd_k)^2,    c_k(a) = sum_j share_kj c_j(a_j)

is a term of the fit, c_j being the contraction of a muscle or a compartment, linear in its values
(:class:`~solver.fitting.drives.ContractionMap`), and a whole muscle's the mean over the volumes of
its compartments. What the table says takes the place of what recruitment expects of such a muscle:
its prior has the usual w_a about the least change of its values that makes the known contraction.

w makes standard deviations comparable with the skin. The skin's term is a mean of squared
distances, 2 sigma^2 / n times minus the logarithm of a likelihood of n distances that are
independent of each other with the standard deviation sigma: so w = 2 sigma^2 / n. Markers, whose
term is such a logarithm itself, have w = 1; there the prior's covariance C makes room for what a
known muscle does by itself, C + s^2 g g^T, g being the least change that makes a contraction of 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from solver.errors import Finding, InputError, make_warning
from solver.fitting.drives import ContractionMap
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, SquaredPrior
from solver.model import find_muscles
from solver.scans.known_activations import KnownMuscles
from solver.surface import Floats, Ints

NOTHING_KNOWN: Mapping[str, KnownMuscles] = {}  # of any expression


@dataclass(frozen=True)
class SkinWorth:
    """Weight of a scan's distances beside a table's standard deviations."""

    sigma_mm: float = 0.3  # by which a fitted skin is off where noise and model leave it
    # distances that err by themselves: 1.6 cm^2 of a face each. S that is wrong errs over all that
    # a muscle moves, noise alone would have tens of times as many
    independent: float = 180.0

    @property
    def weight(self) -> float:
        """Return w, mm^2."""
        return 2.0 * self.sigma_mm**2 / self.independent


SKIN_WORTH = SkinWorth()
MARKERS_WORTH = 1.0  # w beside half a squared Mahalanobis distance
# contraction that a muscle of which a table knows makes by itself, whatever is probable of it: as
# much as muscles of faces contract
OWN_SD = 0.3


@dataclass(frozen=True, eq=False)
class KnownTerm(SquaredPrior):
    """The term of r known contractions: ``rates`` (r, q) are their derivatives by the controls.

    ``rest`` (q,) are the controls at rest, where contractions are 0.
    """

    rates: Floats
    rest: Floats
    values: Floats  # (r,)
    sd: Floats  # (r,)
    weight: float

    @override
    def gradient(self, pose: Pose) -> Floats:
        return np.asarray(self.weight * (self.residuals(pose) / self.sd) @ self.rates)

    @override
    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        out += self.curvature

    @cached_property
    def freedom(self) -> Floats:
        """The covariance (q, q) of what known muscles do by themselves."""
        sizes = (self.rates**2).sum(axis=1, keepdims=True)
        rows = OWN_SD * np.divide(self.rates, sizes, out=np.zeros_like(self.rates), where=sizes > 0)
        return np.asarray(rows.T @ rows)

    @cached_property
    def curvature(self) -> Floats:
        """The term's second derivative (q, q), the same everywhere."""
        root = np.sqrt(self.weight) / self.sd[:, None] * self.rates
        return np.asarray(root.T @ root)

    @override
    def residuals(self, pose: Pose) -> Floats:
        """Return how far the contractions (r,) are off the known ones, in their sd."""
        found = self.rates @ (pose.vector() - self.rest)
        return np.asarray((found - self.values) / self.sd)


@dataclass(frozen=True)
class FaceMuscles:
    """The muscles of a ``face`` under the ``names`` (m) that tables call them by."""

    face: Face
    names: tuple[str, ...]

    @classmethod
    def of(cls, face: Face) -> FaceMuscles:
        """Return the model's muscles."""
        return cls(face, face.model.muscle_names)

    def check(self, known: Iterable[str]) -> None:
        """Raise :class:`InputError` for muscles of which a table cannot know anything.

        ``activations.fibres`` for a muscle without fibres or flesh, ``activations.drive`` for a
        face whose controls are no muscles.
        """
        for name in known:
            if not self._is_usable[find_muscles(name, self.names)].any():
                message = f"{name} has no fibres in the model, so that its contraction says nothing"
                raise InputError("activations.fibres", message, muscle=name)

    def term(self, known: KnownMuscles, weight: float = SKIN_WORTH.weight) -> KnownTerm:
        """Return the term of what is known."""
        layout = self.face.layout
        by_value = np.nan_to_num(self._contractions.rates)
        rates = np.zeros((len(known), layout.size))
        rates[:, layout.muscles] = self._shares(known.names)[:, :, None] * by_value
        return KnownTerm(rates, layout.rest, known.values, known.sd, weight)

    def contractions(self, known: KnownMuscles, a: Floats) -> Floats:
        """Return the contractions (r,) of known muscles by the values ``a`` of all."""
        rest = self.face.layout.drive.rest
        change = (a - rest).reshape(len(rest), -1)
        return self.means(known.names, (self._contractions.rates * change).sum(axis=1))

    def means(self, names: Sequence[str], contractions: Floats) -> Floats:
        """Return the contractions (r,) of muscles and wholes by those (m,) of all muscles."""
        return np.asarray(self._shares(names) @ np.nan_to_num(contractions))

    def numbers(self, known: KnownMuscles) -> Ints:
        """Return the numbers (k,) of the muscles that a table knows, with whole's compartments."""
        own = [self._of(name) for name in known.names]
        return np.unique(np.concatenate(own)) if own else np.array([], dtype=np.int64)

    def regularise(self, known: KnownMuscles, expected: Regulariser) -> Regulariser:
        """Expect the contractions that a table knows of muscles, beside what ``expected`` does.

        ``expected`` says nothing of these muscles itself.
        """
        if not len(known):
            return expected
        rest = self.face.layout.drive.rest
        mean = expected.prior.a.copy()
        # compartments, of which more is known, after their wholes
        for row in sorted(range(len(known)), key=lambda row: len(known.names[row])):
            own = self._of(known.names[row])
            # the least change of a muscle's values that makes the contraction
            rates = self._contractions.rates[own]
            change = known.values[row] * rates / (rates**2).sum(axis=1, keepdims=True)
            mean[own] = rest[own] + change.reshape(rest[own].shape)
        prior = replace(expected.prior, a=mean)
        return replace(expected, prior=prior, others=(*expected.others, self.term(known)))

    def compare(self, known: KnownMuscles, a: Floats) -> tuple[KnownFit, ...]:
        """Return what is known of muscles beside their fitted contractions."""
        rows = zip(known.names, known.values, known.sd, self.contractions(known, a), strict=True)
        return tuple(KnownFit(name, *map(float, numbers)) for name, *numbers in rows)

    def _of(self, name: str) -> Ints:
        """Return the numbers of a muscle, or of a whole's compartments, that have fibres."""
        own = np.array(find_muscles(name, self.names), dtype=np.int64)
        return own[self._is_usable[own]]

    def _shares(self, names: Sequence[str]) -> Floats:
        """Return the shares (r, m) that muscles have in what is called by ``names`` (r)."""
        out = np.zeros((len(names), len(self.names)))
        volumes = self._contractions.volumes
        for row, name in enumerate(names):
            own = self._of(name)
            out[row, own] = volumes[own] / volumes[own].sum()
        return out

    @cached_property
    def _contractions(self) -> ContractionMap:
        found = self.face.contractions
        if found is None or len(found.rates) != len(self.names):
            message = "the muscles of this fit have no contraction that a table could know"
            raise InputError("activations.drive", message)
        return found

    @cached_property
    def _is_usable(self) -> NDArray[np.bool_]:
        found = self._contractions
        return np.asarray(np.isfinite(found.rates).all(axis=1) & (found.volumes > 0.0))


# What the skin says of muscles that a table knows.


@dataclass(frozen=True)
class DisagreementOptions:
    """Limits of a disagreement between table and skin that is worth a warning."""

    most_sd: float = 2.0  # by which skin and table may be apart ...
    often: float = 0.1  # ... but in so many of a take's frames: a twentieth is chance


DISAGREEMENT = DisagreementOptions()


@dataclass(frozen=True)
class KnownFit:
    """A known contraction with its sd, and what was fitted to it and to the skin."""

    muscle: str
    known: float
    sd: float
    contraction: float

    @property
    def off_sd(self) -> float:
        """Return how far the fitted contraction is off, in standard deviations."""
        return (self.contraction - self.known) / self.sd

    def as_dict(self) -> dict[str, str | float]:
        """Return it as JSON values."""
        numbers = {"known": self.known, "sd": self.sd, "contraction": self.contraction}
        numbers["off_sd"] = self.off_sd
        return {"muscle": self.muscle, **{key: round(each, 4) for key, each in numbers.items()}}


def find_disagreements(
    expression: str, fits: Iterable[KnownFit], options: DisagreementOptions = DISAGREEMENT
) -> list[Finding]:
    """Return a warning of each muscle of an expression that skin and table say otherwise of."""
    return [
        make_warning(
            "activations.disagree",
            f"{expression}: {fit.muscle} contracts by {fit.contraction:.2f}, and is known to "
            f"contract by {fit.known:.2f} (sd {fit.sd:.2g}): skin and table disagree by "
            f"{abs(fit.off_sd):.1f} sd",
            {"expression": expression, **fit.as_dict()},
        )
        for fit in fits
        if abs(fit.off_sd) > options.most_sd
    ]


def compare_frames(
    frames: Iterable[tuple[int, tuple[KnownFit, ...]]], options: DisagreementOptions = DISAGREEMENT
) -> tuple[dict[str, Any], list[Finding]]:
    """Return muscle -> figures over the frames that it is known in, and warnings.

    ``frames`` are numbers of frames with what is known in them. ``rms`` is of contractions, and
    ``beyond`` the part of the frames that are more than the options' sd apart.
    """
    by_muscle: dict[str, list[tuple[int, KnownFit]]] = {}
    for number, fits in frames:
        for fit in fits:
            by_muscle.setdefault(fit.muscle, []).append((number, fit))
    figures = {}
    findings = []
    for muscle, rows in by_muscle.items():
        off = np.array([fit.contraction - fit.known for _, fit in rows])
        off_sd = np.abs([fit.off_sd for _, fit in rows])
        beyond = float(np.mean(off_sd > options.most_sd))
        worst, fit = rows[int(off_sd.argmax())]
        figures[muscle] = {
            "frames": len(rows),
            "rms": round(float(np.sqrt(np.mean(off**2))), 4),
            "rms_sd": round(float(np.sqrt(np.mean(off_sd**2))), 4),
            "beyond": round(beyond, 4),
            "worst": {"frame": worst, **fit.as_dict()},
        }
        if beyond > options.often:
            message = (
                f"{muscle}: skin and table disagree by more than {options.most_sd:g} sd in "
                f"{100 * beyond:.0f} % of the frames that it is known in, most in frame {worst}: "
                f"it contracts by {fit.contraction:.2f}, known is {fit.known:.2f}"
            )
            context = {"muscle": muscle, "frame": worst}
            findings.append(make_warning("activations.disagree", message, context))
    return figures, findings
