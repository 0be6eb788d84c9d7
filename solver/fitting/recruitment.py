"""Recruitment: which muscles a scan calls for, and what the others pay to take part.

The skin alone hardly tells which muscle pulls: an inverse fit of a finite-element face to markers
of the lips had activations that correlated by 0.27 and 0.20 with simulated and measured ones (Eskes
et al., Scientific Reports 7, 2017). Anatomy tells more. The expressions of a template consist of
action units of FACS, and each unit names the muscles that make it, and those that it works against
(:mod:`solver.anatomy.action_units`).

In goes a face, whose model keeps its template's expressions, and a target, the points of one scan.
Out comes what is expected of each muscle in that scan (:class:`Recruited`). The fit of the scan
then has this in the place of its plain price w_a/2 |a_j - I|^2, where a_j are the six numbers of
muscle j, I those at rest, and w_a is a weight. Of the symbols below hurdle, called, contraction,
price, opposed, effort, small, even and strict are fields of :class:`RecruitmentOptions`. There are
four steps.

1. How much of each expression is in the scan? Its points t are nearly

    t = rest + sum_e u_e motion_e,    u_e >= 0.

Expression e moves the face by motion_e, and u_e is its amount, 1 at full strength. The amounts are
found by non-negative least squares over what the scan shows. The part of |t - rest|^2 that the sum
explains is r, from 0 to 1.

Some units are in no expression. Their motions are predicted (:mod:`.predicted_units`) and less
certain, so that their amounts cost: where l is what the expressions leave of the scan, the least
squares have the further term hurdle |l| |motion_e| u_e. Such a unit takes part only if the
cosine between its motion and l is greater than hurdle.

2. Which muscles does the scan call for? For each muscle j there are three numbers from 0 to 1,

    u_j = min(1, max_e u_e),
    c_j = min(1, max_e u_e / called),
    d_j = min(1, max_e u_e / called).

The first two are over the expressions with a unit that names muscle j: u_j is how strongly it is
asked to pull, c_j how surely it takes part. d_j is over those with a unit that works against it.

3. What is muscle j expected to do, and what does anything else cost?

    w_a/2 price_j^r |a_j - m_j|^2,    price_j = price opposed^(d_j (1 - c_j)).

m_j are the six numbers of a muscle whose fibres have shortened by the part contraction u_j of
their length while it keeps its volume. So a muscle that nothing calls for is expected at rest. An
antagonist of what is called for pays most. Where the expressions explain nothing (r = 0) nobody
pays more than w_a: what is no known expression anybody may make.

This price is quadratic, so that it is least where every muscle does a little. A linear price leaves
the work to few; both are criteria of load sharing (Crowninshield and Brand 1981, "A physiologically
based criterion of muscle force prediction in locomotion"). So a muscle that is not called for also
pays for its contraction k_j along its fibres (:class:`~solver.fitting.drives.ContractionMap`),

    w_a effort r (1 - c_j) (sqrt(k_j^2 + small^2) - small).

It is linear but for contractions below small, where it is smooth. Gauss-Newton steps take a
parabola in its place, which touches it at k_j and is above it elsewhere.

4. Do both sides do the same? For pairs of a muscle j and its counterpart j' on the other side,

    w_a/2 even r sum_jj' v_jj' (|a_j - M a_j'|^2 + (k_j - k_j')^2).

M turns an activation into its mirror image. Contractions are compared as well, because neither a
mesh nor the fibres in it are their own mirror images. v_jj', from 0 to 1, is how alike the scan
calls for both:

    v_jj' = b (1 - |u_j - u_j'| / max(u_j, u_j')) + (1 - b) s^strict,    b = max(c_j, c_j'),
    s = max(0, 1 - sum_e |u_e - u_e'| / sum_e u_e),

where e' is expression e on the other side, and s is how alike both sides of the scan are as a
whole. That decides for pairs that nothing calls for (b = 0): in a one-sided smile they need not be
alike.

Muscles that close the jaw are silent while it is open, whatever the scan calls for
(:mod:`solver.fitting.jaw_closers`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import nnls
from typing_extensions import override

from solver.anatomy.action_units import find_called
from solver.fitting.face import Face, Pose
from solver.fitting.jaw_closers import CloserOptions, SilentClosers
from solver.fitting.objective import Prior, Regulariser, Target
from solver.fitting.predicted_units import predict_units
from solver.fitting.simplex import mirrored_pairs
from solver.fitting.stretches import IsochoricActivations, fibre_tensors
from solver.mechanics.flesh import IDENTITY
from solver.model import SubjectModel
from solver.surface import Floats, Ints

TINY = 1e-12  # an amount of an expression to divide by in place of none


@dataclass(frozen=True)
class RecruitmentOptions:
    """What is expected of muscles, and what else they do costs."""

    contraction: float = 0.25  # of a muscle whose expression is at full strength
    price: float = 30.0  # by which w_a is greater than where nothing is known
    opposed: float = 10.0  # by which that of a muscle is greater that works against one called for
    called: float = 0.25  # amount of an expression from which its muscles are called for wholly
    even: float = 100.0  # by which what both sides do otherwise costs more than w_a
    strict: float = 8.0  # power of how alike sides are, for muscles that nothing calls for
    effort: float = 0.0  # slope of the price of contraction that nobody calls for, by w_a
    small: float = 0.02  # contraction below which that price is quadratic
    # cosine to what expressions leave, from which a unit that none of them shows takes part
    hurdle: float = 0.05
    closers: CloserOptions = field(
        default_factory=CloserOptions
    )  # what closes the jaw, while it is open


# A trained S (:mod:`solver.fitting.training`) leaves the work to the right muscles by itself, so
# that a lower price does; effort takes away what many others would add by a little each
TRAINED = RecruitmentOptions(price=4.0, opposed=30.0, effort=30.0)


def usual_options(model: SubjectModel) -> RecruitmentOptions:
    """Return what is expected of a model's muscles, by whether its template is trained."""
    return RecruitmentOptions() if model.trained is None else TRAINED


def why_none(face: Face) -> str:
    """Return why nothing is expected of a face's muscles, in words; "" if something is."""
    shapes = face.model.expressions
    if shapes is None:
        return "the model keeps no expressions of its template"
    if face.layout.drive.penalty is None:
        return f"the muscles are driven by {face.drive.name}, which has no shapes of muscles"
    muscles = face.model.muscle_names
    if not any(any(find_called(muscles, name)[0]) for name in shapes.names):
        return "none of the template's expressions has a unit of FACS that its muscles make"
    return ""


@dataclass(frozen=True, eq=False)
class Recruitment:
    """Who makes the template's expressions on a person, and units that none of them shows.

    ``motions`` (e, k, 3) are those of the face's points, mm, off ``rest`` (k, 3). ``named`` (e, m)
    tells whether a unit of an expression names a muscle, on its side, and ``opposed`` (e, m)
    whether it is an antagonist of one. ``mirrored`` (e,) are the numbers of the same expressions
    on the other side, their own in the middle and -1 where there is none.
    ``shown`` (e,) tells which are expressions: amounts of the others, predicted ones, cost
    ``options.hurdle`` by the sizes of motions.
    """

    names: tuple[str, ...]  # (e,)
    motions: NDArray[np.floating]
    named: NDArray[np.bool_]
    opposed: NDArray[np.bool_]
    rest: Floats
    mirrored: Ints
    shown: NDArray[np.bool_]
    priors: FibrePriors
    options: RecruitmentOptions = RecruitmentOptions()
    _last: list[_SeenMotions] = field(init=False, default_factory=list)  # as the last target did

    @classmethod
    def of_face(cls, face: Face, options: RecruitmentOptions | None = None) -> Recruitment | None:
        """Read from a face's model who makes which expression; None where :func:`why_none` says so.

        ``options`` are by default those of :func:`usual_options`.
        """
        model = face.model
        shapes = model.expressions
        if shapes is None or why_none(face):
            return None
        chosen = options or usual_options(model)
        unshown = predict_units(face)
        names = (*shapes.names, *unshown.names)
        motions = np.concatenate([shapes.motions, unshown.motions])
        shown = np.arange(len(names)) < len(shapes.names)
        named, opposed = np.array(
            [find_called(model.muscle_names, name) for name in names]
        ).swapaxes(0, 1)
        rest = model.skin.vertices[model.face]
        priors = FibrePriors.of_face(face, chosen.small, chosen.closers)
        mirrored = _mirror_numbers(names)
        return cls(names, motions, named, opposed, rest, mirrored, shown, priors, chosen)

    def of_target(self, target: Target) -> Recruited:
        """Return what is expected of every muscle in a target."""
        options, (amounts, explained) = self.options, self.amounts(target)
        shares = np.minimum(amounts / options.called, 1.0)[:, None]
        called, against = ((shares * each).max(axis=0) for each in (self.named, self.opposed))
        price = options.price * options.opposed ** (against * (1.0 - called))
        strengths = (np.minimum(amounts, 1.0)[:, None] * self.named).max(axis=0)
        contraction = options.contraction * strengths
        even = options.even * explained * self._evenness(amounts, strengths, called)
        effort = options.effort * explained * (1.0 - called)
        return Recruited((price**explained)[:, None], contraction, even, effort, self.priors)

    def _evenness(self, amounts: Floats, strengths: Floats, called: Floats) -> Floats:
        """Return how alike the muscles of each pair (p,) are called for, from 0 to 1.

        ``amounts`` (e,) are those of the expressions, ``strengths`` (m,) what they call each muscle
        for, and ``called`` (m,) whether they do, from 0 to 1.
        """
        other = np.append(amounts, 0.0)[self.mirrored]
        whole = max(1.0 - np.abs(amounts - other).sum() / max(amounts.sum(), TINY), 0.0)
        left, right = self.priors.sides.pairs.T
        most = np.maximum(strengths[left], strengths[right])
        own = 1.0 - np.abs(strengths[left] - strengths[right]) / np.maximum(most, TINY)
        either = np.maximum(called[left], called[right])
        return np.asarray(either * own + (1.0 - either) * whole**self.options.strict)

    def amounts(self, target: Target) -> tuple[Floats, float]:
        """Return the amounts (e,) of the expressions whose sum is nearest to a target.

        The second is the part of its squared motion that they explain, from 0 to 1. A jaw that
        opens is an expression like any other.
        """
        seen = self._seen(target)
        rows = seen.rows
        motion = seen.of_points(target.points - self.rest)
        whole = float(motion @ motion)
        if whole == 0.0:
            return np.zeros(len(rows)), 0.0
        shown = self.shown
        products = rows @ motion
        amounts = np.zeros(len(rows))
        amounts[shown] = _least_amounts(seen.root_of_shown, products[shown])
        left = motion - amounts @ rows
        if not shown.all():
            hurdles = np.where(shown, 0.0, self.options.hurdle)
            costs = hurdles * np.linalg.norm(left) * seen.sizes
            amounts = _least_amounts(seen.root, products - costs)
            left = motion - amounts @ rows
        return amounts, max(1.0 - float(left @ left) / whole, 0.0)

    def explained_by(self, target: Target, chosen: NDArray[np.bool_]) -> float:
        """Return the part of a target's squared motion that ``chosen`` (e,) expressions explain."""
        seen = self._seen(target)
        rows = seen.rows[chosen]
        motion = seen.of_points(target.points - self.rest)
        left = motion - _least_amounts(_root(rows @ rows.T), rows @ motion) @ rows
        return max(1.0 - float(left @ left) / max(float(motion @ motion), TINY), 0.0)

    def _seen(self, target: Target) -> _SeenMotions:
        """Return the motions as a target sees them, which many targets do alike."""
        for before in self._last:
            if before.is_of(target):
                return before
        found = _SeenMotions.of(self.motions, self.shown, target)
        self._last[:] = [found]
        return found


@dataclass(frozen=True, eq=False)
class _SeenMotions:
    """Motions of e expressions as a target sees them, weighted, along its normals if it has any."""

    weights: Floats  # (k,)
    normals: Floats | None  # (k, 3)
    rows: Floats  # (e, points or coordinates that are seen)
    sizes: Floats  # (e,) of the rows
    root: Floats  # of what the rows have in common, lower triangular (e, e)
    root_of_shown: Floats  # of those of expressions alone

    @classmethod
    def of(
        cls, motions: NDArray[np.floating], shown: NDArray[np.bool_], target: Target
    ) -> _SeenMotions:
        """Return how a target sees ``motions`` (e, k, 3), of which some are ``shown`` (e,)."""
        rows = _seen_by(target.weights, target.normals, motions).reshape(len(motions), -1)
        square = rows @ rows.T
        roots = _root(square), _root(square[np.ix_(shown, shown)])
        return cls(target.weights, target.normals, rows, np.linalg.norm(rows, axis=1), *roots)

    def is_of(self, target: Target) -> bool:
        """Tell whether a target sees alike."""
        alike = self.normals is None and target.normals is None
        return alike and np.array_equal(self.weights, target.weights)

    def of_points(self, motion: Floats) -> Floats:
        """Return how a ``motion`` (k, 3) is seen."""
        return _seen_by(self.weights, self.normals, motion).ravel()


def _seen_by(weights: Floats, normals: Floats | None, motions: NDArray[np.floating]) -> Floats:
    """Return ``motions`` (..., k, 3) of the points that have weights (k,), times their roots.

    Along ``normals`` (k, 3), if there are any, they are numbers.
    """
    seen = weights > 0.0
    rows = np.sqrt(weights[seen])[:, None] * motions[..., seen, :]
    return np.asarray(rows if normals is None else (rows * normals[seen]).sum(axis=-1))


@dataclass(frozen=True, eq=False)
class Recruited:
    """What is expected of m muscles in one expression."""

    price: Floats  # (m, 1) by which w_a is greater
    contraction: Floats  # (m,) by which their fibres shorten
    even: Floats  # (p,) weights of what both muscles of a pair do otherwise, by w_a
    effort: Floats  # (m,) weights of their contractions, by w_a
    priors: FibrePriors

    def on(self, face: Face) -> Recruited:
        """Expect the same of the muscles of ``face``, whose S gives them other fibres."""
        return replace(self, priors=self.priors.on(face))

    def without(self, muscles: Ints) -> Recruited:
        """Expect nothing of ``muscles`` (k,), of which a table knows more."""
        price = self.price.copy()
        contraction = self.contraction.copy()
        effort = self.effort.copy()
        price[muscles] = 1.0
        contraction[muscles] = 0.0
        effort[muscles] = 0.0
        closers = self.priors.closers.without(muscles)
        priors = replace(self.priors, closers=closers)
        return replace(self, price=price, contraction=contraction, effort=effort, priors=priors)

    def regularise(self, plain: Regulariser) -> Regulariser:
        """Put these expectations in the place of a ``plain`` regulariser's, of muscles at rest."""
        priors = self.priors
        prior = replace(plain.prior, a=priors.shortened(self.contraction))
        unit = float(np.min(plain.w_a))
        sides = replace(priors.sides, weights=unit * self.even)
        effort = replace(priors.effort, weights=unit * self.effort)
        closers = replace(priors.closers, weight=unit * priors.closers.weight)
        others = (*plain.others, sides, effort, closers)
        return replace(plain, w_a=plain.w_a * self.price, prior=prior, others=others)


@dataclass(frozen=True, eq=False)
class FibrePriors:
    """Priors that go by the fibres which S gives the muscles of a face.

    ``fibred`` (k,) are the muscles that have any, ``isochoric`` their activations by the stretch.
    """

    fibred: Ints
    isochoric: IsochoricActivations
    sides: EvenSides
    effort: Effort
    closers: SilentClosers  # its weight by w_a

    @classmethod
    def of_face(cls, face: Face, small: float, closers: CloserOptions) -> FibrePriors:
        """Make the priors of a face's muscles, with weights of 0 for effort.

        ``small`` is the contraction below which the price of effort is quadratic.
        """
        tensors = fibre_tensors(face.model, face.flesh.volumes, face.S)
        fibred = np.flatnonzero(np.isfinite(tensors[:, 0, 0]))
        effort = Effort.of_face(face, small)
        silent = SilentClosers.of_face(face, closers)
        isochoric = IsochoricActivations.of(tensors[fibred])
        return cls(fibred, isochoric, EvenSides.of_face(face), effort, silent)

    def on(self, face: Face) -> FibrePriors:
        """Make the priors of another face, with the same options."""
        return FibrePriors.of_face(face, self.effort.small, self.closers.options)

    def shortened(self, contraction: Floats) -> Floats:
        """Return the activations (m, 6) of muscles whose fibres have shortened, their volume kept.

        ``contraction`` (m,) is the part that they lost: where it is 0 muscles rest, to the last
        digit.
        """
        out = np.tile(IDENTITY, (len(contraction), 1))
        own = contraction[self.fibred]
        pulls = own > 0.0
        out[self.fibred[pulls]] = self.isochoric(1.0 - own)[pulls]
        return out


@dataclass(frozen=True, eq=False)
class Effort(Prior):
    """The linear price of contractions k_j: sum_j weights_j (sqrt(k_j^2 + small^2) - small).

    ``places`` (m, 6) are those of a_j among the controls, ``rates`` (m, 6) are dk_j/da_j.
    """

    places: Ints
    rates: Floats
    small: float
    weights: Floats  # (m,)

    @classmethod
    def of_face(cls, face: Face, small: float) -> Effort:
        """Make the price of a face's muscles, with weights of 0; without fibres none ever pays."""
        places = face.layout.muscles
        found = face.contractions
        rates = np.zeros(places.shape) if found is None else np.nan_to_num(found.rates)
        return cls(places, rates, small, np.zeros(len(places)))

    @override
    def value(self, pose: Pose) -> float:
        return float(self.weights @ (self._smooth(self._contractions(pose)) - self.small))

    @override
    def gradient(self, pose: Pose) -> Floats:
        contractions = self._contractions(pose)
        out = np.zeros(pose.layout.size)
        slopes = self.weights * contractions / self._smooth(contractions)
        out[self.places] = slopes[:, None] * self.rates
        return out

    @override
    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        # of the parabola that touches the price at k_j, and at -k_j, and is above it elsewhere
        bends = self.weights / self._smooth(self._contractions(pose))
        blocks = bends[:, None, None] * self.rates[:, :, None] * self.rates[:, None, :]
        out[self.places[:, :, None], self.places[:, None, :]] += blocks

    def _contractions(self, pose: Pose) -> Floats:
        return np.asarray((self.rates * (pose.a - IDENTITY)).sum(axis=1))

    def _smooth(self, contractions: Floats) -> Floats:
        return np.asarray(np.hypot(contractions, self.small))


# Of the six entries of S(a), those of its mirror image, x being to the side.
MIRROR = np.array([1.0, -1.0, -1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class EvenSides(Prior):
    """The price of what both sides do otherwise: sum_p weights_p/2 |R_p (a_j, a_j')|^2 of pairs p.

    ``pairs`` (p, 2) are the numbers j, j' of their muscles, ``places`` (p, 12) those of a_j and
    a_j' among the controls. ``rows`` R (p, 7, 12) are the differences of their entries, mirrored,
    and of their contractions, and ``squares`` (p, 12, 12) R_p^T R_p.
    """

    pairs: Ints
    places: Ints
    rows: Floats
    squares: Floats
    weights: Floats  # (p,)

    @classmethod
    def of_face(cls, face: Face) -> EvenSides:
        """Pair the muscles of a face with those of their names on the other side, weights of 1."""
        pairs = mirrored_pairs(face.model.muscle_names)
        places = face.layout.muscles[pairs].reshape(len(pairs), -1)
        rows = np.zeros((len(pairs), 7, 12))
        rows[:, :6] = np.hstack([np.eye(6), -np.diag(MIRROR)])
        if face.contractions is not None:
            left, right = face.contractions.rates[pairs.T]
            both = np.hstack([left, -right])
            # a muscle without flesh contracts by nothing, and says nothing of its twin
            rows[:, 6] = np.where(np.isfinite(both).all(axis=1)[:, None], both, 0.0)
        return cls(pairs, places, rows, rows.transpose(0, 2, 1) @ rows, np.ones(len(pairs)))

    @override
    def value(self, pose: Pose) -> float:
        return float(0.5 * self.weights @ (self._differences(pose) ** 2).sum(axis=1))

    @override
    def gradient(self, pose: Pose) -> Floats:
        out = np.zeros(pose.layout.size)
        pull = np.einsum("prk,pr->pk", self.rows, self._differences(pose))
        out[self.places] = self.weights[:, None] * pull
        return out

    @override
    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        places = self.places
        out[places[:, :, None], places[:, None, :]] += self.weights[:, None, None] * self.squares

    def _differences(self, pose: Pose) -> Floats:
        """Return R_p (a_j, a_j') of every pair (p, 7)."""
        # at rest both sides are alike, and so the controls themselves will do
        return np.asarray(np.einsum("prk,pk->pr", self.rows, pose.vector()[self.places]))


def _root(square: Floats) -> Floats:
    """Return the Cholesky factor of what rows have in common.

    Rows that are sums of others, or are not seen, are left where they are.
    """
    return np.linalg.cholesky(square + 1e-9 * np.trace(square) * np.eye(len(square)))


def _least_amounts(root: Floats, slopes: Floats) -> Floats:
    """Return the u (e,) >= 0 with the least |root^T u|^2 / 2 - slopes . u."""
    goal = scipy.linalg.solve_triangular(root, slopes, lower=True)
    return np.asarray(nnls(root.T, goal)[0])


def _mirror_numbers(expressions: tuple[str, ...]) -> Ints:
    """Return the numbers of the expressions on the other side, -1 where there is none."""
    numbers = {name: number for number, name in enumerate(expressions)}
    swapped = {"Left": "Right", "Right": "Left"}

    def other(name: str) -> str:
        for side, opposite in swapped.items():
            if name.endswith(side):
                return name.removesuffix(side) + opposite
        return name

    return np.array([numbers.get(other(name), -1) for name in expressions])


def recruit(
    face: Face, targets: Mapping[str, Target], options: RecruitmentOptions | None = None
) -> dict[str, Recruited]:
    """Return target -> what it calls for; {} where nothing is known of a face's muscles."""
    recruitment = Recruitment.of_face(face, options)
    if recruitment is None:
        return {}
    return {name: recruitment.of_target(target) for name, target in targets.items()}
