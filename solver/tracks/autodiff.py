"""A face under tracks as a function that JAX or PyTorch differentiates: from controls to skin.

    q (K + 5,)  ->  skin (V, 3),    d skin = J dq,    g -> J^T g

J is :class:`~solver.tracks.response.TrackResponse`'s, exact through equilibrium and contact: one
factorisation for each state, one solve for each product. Frameworks hand arrays over and keep no
states, so what a derivative needs, q and the flesh's x, goes with the value: a derivative is always
that of the very state whose skin was returned, however many were solved for since.

Evaluations begin at the nearest state that is kept. Flesh that buckles has several equilibria, and
which one is found then hangs on those; otherwise the value is a function of q, to the face's
``tolerance``. There are no second derivatives.
"""

from __future__ import annotations

import threading
import warnings
from collections import deque
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Literal, cast, get_args

import numpy as np

from solver.errors import InputError, SolveError
from solver.surface import Floats
from solver.tracks.face import TrackFace
from solver.tracks.response import TrackResponse, TrackState

Mode = Literal["reverse", "forward"]
Array = Any  # of JAX
Tensor = Any  # of PyTorch

KEPT = 16  # states that evaluations may begin at: a batch of so many goes on from its last values


class SkinMap:
    """Values and products of a face's skin as functions of q, for frameworks that keep no state.

    ``start`` is a state to begin at, by default the face at rest; ``kept`` is how many of the last
    ones are kept beside it. Calls from several threads wait for one another, as states of a face
    share its contact.
    """

    def __init__(self, face: TrackFace, start: TrackState | None = None, kept: int = KEPT) -> None:
        self.size = face.tracks.size
        self.skin_shape = face.model.skin.vertices.shape
        self.flesh_shape = face.model.rest.shape
        self._face = face
        self._start = start
        self._states: deque[TrackState] = deque(maxlen=kept)
        self._last: tuple[Floats, Floats, TrackResponse] | None = None
        self._lock = threading.RLock()
        self._has_told_precision = False

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """Raise :class:`InputError` (``tracks.controls``) for anything but (..., K + 5)."""
        if not shape or shape[-1] != self.size:
            message = f"controls are {self.size} numbers each, not of shape {shape}"
            raise InputError("tracks.controls", message, expected=self.size)

    def tell_precision(self, double: bool, how: str) -> None:
        """Warn, once, of controls in less than double precision; ``how`` says what to do."""
        if double or self._has_told_precision:
            return
        self._has_told_precision = True
        message = (
            "controls are cast to double precision, skin and derivatives back to theirs, which "
            f"leaves some 1e-5 mm of the skin: {how}"
        )
        warnings.warn(message, UserWarning, stacklevel=3)

    def state(self, q: Floats) -> TrackState:
        """Return the face under q (K + 5,), kept if there; raises as ``TrackFace.move``."""
        with self._lock:
            start = self._start = self._start or self._face.rest()
            nearest = min((start, *self._states), key=lambda each: np.linalg.norm(each.q - q))
            if np.array_equal(nearest.q, q):
                return nearest
            found = self._face.move(nearest, q)
            self._states.append(found)
            return found

    def skin(self, state: TrackState) -> Floats:
        """Return the skin (V, 3) of a state."""
        return self._face.skin(state)

    def product(self, q: Floats, x: Floats, change: Floats) -> Floats:
        """Return J dq (V, 3) for dq (K + 5,), of the state under q whose flesh is at x (p, 3).

        Raises as :class:`TrackResponse`.
        """
        with self._lock:
            return self._response(q, x).skin_product(change)

    def adjoint(self, q: Floats, x: Floats, gradient: Floats) -> Floats:
        """Return J^T g (K + 5,) for g (V, 3); otherwise as :meth:`product`."""
        with self._lock:
            return self._response(q, x).skin_adjoint(gradient)

    def _response(self, q: Floats, x: Floats) -> TrackResponse:
        """Return the derivatives of a state; those of the last one are kept, factorised."""
        if self._last is not None:
            last_q, last_x, response = self._last
            if np.array_equal(last_q, q) and np.array_equal(last_x, x):
                return response
        found = TrackResponse(self._face, self._face.state_at(q, x))
        self._last = q, x, found
        if not found.minimum:
            message = "flesh is about to buckle here: its derivative leads off the equilibrium"
            warnings.warn(message, RuntimeWarning, stacklevel=4)
        return found


def jax_function(
    face: TrackFace, mode: Mode = "reverse", start: TrackState | None = None, kept: int = KEPT
) -> Callable[[Array], Array]:
    """Return the skin (..., V, 3) by controls (..., K + 5) as a function that JAX differentiates.

    JAX takes one rule a function. That of ``reverse`` serves ``jax.grad``, ``vjp`` and ``jacrev``,
    that of ``forward`` ``jax.jvp`` and ``jacfwd``. Both work under ``jit``, and under ``vmap`` as
    with leading axes one state after the other. ``start`` and ``kept`` are :class:`SkinMap`'s.

    Raises :class:`InputError`: ``tracks.extra`` without JAX, ``tracks.options`` for another mode;
    the function ``tracks.controls`` for another shape, and ``tracks.second_derivative`` where its
    derivative is to be differentiated. Errors of values, which are those of ``TrackFace.move`` and
    :class:`TrackResponse`, JAX hands on as a ``JaxRuntimeError`` that ends with code and sentence.
    """
    if mode not in get_args(Mode):
        message = f"mode {mode!r} is none of {', '.join(get_args(Mode))}"
        raise InputError("tracks.options", message, found=mode)
    if find_spec("jax") is None:
        message = "JAX is not installed: pip install 'myoface[jax]'"
        raise InputError("tracks.extra", message, package="jax")
    import jax

    skin_map = SkinMap(face, start, kept)
    rules = _JaxRules(jax, skin_map)
    of_one = rules.reverse() if mode == "reverse" else rules.forward()

    def skin(q: Array) -> Array:
        q = jax.numpy.asarray(q)
        skin_map.check_shape(q.shape)
        skin_map.tell_precision(q.dtype == np.float64, "jax.config.update('jax_enable_x64', True)")
        if not jax.numpy.issubdtype(q.dtype, jax.numpy.floating):
            q = q.astype(float)
        of_all = of_one
        for _ in q.shape[:-1]:
            of_all = jax.vmap(of_all)
        return of_all(q)

    return skin


class _JaxRules:
    """The skin (V, 3) by q (K + 5,) for the module ``jax``, with one of its rules."""

    def __init__(self, jax: Any, skin_map: SkinMap) -> None:
        self._jax = jax
        self._map = skin_map
        # x, bit for bit, in a type that JAX has whether or not it has double precision
        self._flesh = jax.ShapeDtypeStruct((*skin_map.flesh_shape, 2), np.uint32)
        # rules take q through this: who differentiates it, differentiates a derivative
        self._once: Any = jax.custom_jvp(lambda q: q)
        self._once.defjvp(_refuse)

    def reverse(self) -> Callable[[Array], Array]:
        """Return the function with a rule for J^T g."""

        def begin(q: Array) -> tuple[Array, Any]:
            q = self._once(q)
            skin, flesh = self._solve(q)
            return skin, (q, flesh)

        def pull(kept: Any, gradient: Array) -> tuple[Array]:
            q, flesh = kept
            shape = (self._map.size,)
            return (self._linear(self._map.adjoint, shape, self._once(q), flesh, gradient),)

        function: Any = self._jax.custom_vjp(lambda q: self._solve(q)[0])
        function.defvjp(begin, pull)
        return cast("Callable[[Array], Array]", function)

    def forward(self) -> Callable[[Array], Array]:
        """Return the function with a rule for J dq."""

        def push(primals: Any, tangents: Any) -> tuple[Array, Array]:
            q = self._once(primals[0])
            skin, flesh = self._solve(q)
            return skin, self._linear(self._map.product, skin.shape, q, flesh, tangents[0])

        function: Any = self._jax.custom_jvp(lambda q: self._solve(q)[0])
        function.defjvp(push)
        return cast("Callable[[Array], Array]", function)

    def _solve(self, q: Array) -> Any:
        """Return the skin, and the bits of the flesh that it is of."""

        def work(q: Array) -> tuple[Floats, Any]:
            state = self._map.state(_double(q))
            bits = np.ascontiguousarray(state.x).view(np.uint32)
            return self._map.skin(state).astype(q.dtype), bits.reshape(self._flesh.shape)

        skin = self._jax.ShapeDtypeStruct(self._map.skin_shape, q.dtype)
        return self._call(work, (skin, self._flesh), q)

    def _linear(
        self,
        of: Callable[[Floats, Floats, Floats], Floats],
        shape: tuple[int, ...],
        q: Array,
        flesh: Array,
        given: Array,
    ) -> Array:
        """Return a product ``of`` the map at a state: with ``given``, linearly."""

        def work(q: Array, flesh: Array, given: Array) -> Floats:
            # a copy: the derivatives at x are kept, and these bits may be JAX's own memory
            x = np.array(flesh).view(np.float64).reshape(self._map.flesh_shape)
            return of(_double(q), x, _double(given)).astype(q.dtype)

        return self._call(work, self._jax.ShapeDtypeStruct(shape, q.dtype), q, flesh, given)

    def _call(self, work: Callable[..., Any], shapes: Any, *arrays: Array) -> Any:
        """Let JAX call ``work``, one state after the other where there are several."""

        def told(*arrays: Array) -> Any:
            try:
                return work(*arrays)
            except (InputError, SolveError) as error:
                error.args = (f"{error.code}: {error.message}",)  # JAX hands on the text alone
                raise

        return self._jax.pure_callback(told, shapes, *arrays, vmap_method="sequential")


def _refuse(*_: Any) -> Any:
    message = "a face has first derivatives only: grad, jvp and their like do not nest on it"
    raise InputError("tracks.second_derivative", message)


def torch_function(
    face: TrackFace, start: TrackState | None = None, kept: int = KEPT
) -> Callable[[Tensor], Tensor]:
    """Return the skin (..., V, 3) by controls (..., K + 5) as a function of PyTorch's tensors.

    It has both derivatives, backward and forward; that they are not differentiated again is told by
    PyTorch. ``start`` and ``kept`` are :class:`SkinMap`'s.

    Raises :class:`InputError`: ``tracks.extra`` without PyTorch; the function ``tracks.controls``,
    and as ``TrackFace.move`` and :class:`TrackResponse` do.
    """
    if find_spec("torch") is None:
        message = "PyTorch is not installed: see pytorch.org for the package of this machine"
        raise InputError("tracks.extra", message, package="torch")
    import torch

    skin_map = SkinMap(face, start, kept)
    of_rows = _torch_rows(torch, skin_map)

    def skin(q: Tensor) -> Tensor:
        skin_map.check_shape(tuple(q.shape))
        skin_map.tell_precision(q.dtype == torch.float64, "give them as torch.float64")
        rows = of_rows(q.reshape(-1, skin_map.size))
        return rows.reshape(*q.shape[:-1], *skin_map.skin_shape)

    return skin


def _torch_rows(torch: Any, skin_map: SkinMap) -> Callable[[Tensor], Tensor]:
    """Return the skins (b, V, 3) by controls (b, K + 5) for the module ``torch``."""

    def each(
        work: Callable[..., Floats], states: list[TrackState], given: Tensor, like: Tensor
    ) -> Tensor:
        pairs = zip(states, _double(given.detach().cpu()), strict=True)
        found = [work(state.q, state.x, row) for state, row in pairs]
        return torch.from_numpy(np.stack(found)).to(like)

    def pull(ctx: Any, gradient: Tensor) -> Tensor:
        return each(skin_map.adjoint, ctx.states, gradient, ctx.like)

    class Skins(torch.autograd.Function):  # type: ignore[misc]
        """The skins; the context keeps their states for both derivatives."""

        @staticmethod
        def forward(ctx: Any, q: Tensor) -> Tensor:
            q = q.detach()
            ctx.states = [skin_map.state(row) for row in _double(q.cpu())]
            ctx.like = q
            return torch.from_numpy(np.stack([skin_map.skin(state) for state in ctx.states])).to(q)

        backward = staticmethod(torch.autograd.function.once_differentiable(pull))

        @staticmethod
        def jvp(ctx: Any, change: Tensor) -> Tensor:
            return each(skin_map.product, ctx.states, change, ctx.like)

    return cast("Callable[[Tensor], Tensor]", Skins.apply)


def _double(values: Array) -> Floats:
    return np.asarray(values).astype(np.float64)
