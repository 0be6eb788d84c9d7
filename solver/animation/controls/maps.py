"""Maps from weights of shapes to coordinates, learned from pairs: a polynomial, and a network.

Both are zero at rest. They are learned apart, and where they disagree neither is to be trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Self

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from solver.surface import Floats, Ints

Listen = Callable[[float], None]  # to the part of the work that is done
Singles = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ShapeSizes:
    """Sizes of shapes: how far each moves the face, alone and where it overlaps with others.

    ``alone`` (e,) are root mean squares in mm, ``together`` (e, e) the same of the geometric means
    of two shapes' motions: two that move other parts of the face hardly change each other.
    """

    alone: Floats
    together: Floats

    @classmethod
    def of(cls, motions: Floats) -> ShapeSizes:
        """Measure shapes by their ``motions`` (e, k, 3) of the face's points, mm."""
        lengths = np.linalg.norm(motions, axis=2)
        alone = np.sqrt(np.mean(lengths**2, axis=1))
        common = lengths @ lengths.T / lengths.shape[1]
        return cls(alone, common / np.sqrt(np.outer(alone, alone)))


@dataclass(frozen=True)
class PolynomialOptions:
    """Ridge regression, of coefficients that are as great as shapes move the face."""

    ridge: float = 3e-5  # of c_i, in units of the shape's size ...
    ridge_products: float = 0.3  # ... of c_i c_j, of how far both move the same ...
    ridge_cubes: float = 0.3  # ... and of c_i^3
    least_mm: float = 0.1  # that two shapes move together, to have a product


@dataclass(frozen=True, eq=False)
class PolynomialMap:
    """y = sum_i c_i l_i + c_i^3 k_i + sum_(i <= j) c_i c_j m_ij of weights c (e,).

    ``products`` (p, 2) are the pairs (i, j), ``rows`` (2 e + p, r) the coefficients l, k and m.
    """

    products: Ints
    rows: Singles

    @classmethod
    def learn(
        cls,
        weights: Floats,
        goals: Floats,
        sizes: ShapeSizes,
        options: PolynomialOptions = PolynomialOptions(),
    ) -> Self:
        """Learn from weights (n, e) of shapes and their coordinates (n, r)."""
        known = Leverage.of(weights, sizes, options)
        rows = known.solve(_features(weights, known.products).T @ goals)
        return cls(known.products, rows.astype(np.float32))

    def __call__(self, weights: NDArray[np.floating]) -> Singles:
        """Return the coordinates (..., r) of weights (..., e)."""
        return np.asarray(_features(weights.astype(np.float32), self.products) @ self.rows)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what a file has of it."""
        return {"products": self.products, "rows": self.rows}

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Return what :meth:`arrays` gave."""
        return cls(arrays["products"], arrays["rows"])


@dataclass(frozen=True, eq=False)
class Leverage:
    """How little pairs tell a polynomial of other weights: their leverage.

    ``root`` is L of the ridge regression's normal matrix, L L^T = F^T F + R, for features F.
    """

    products: Ints
    root: Floats

    @classmethod
    def of(
        cls, weights: Floats, sizes: ShapeSizes, options: PolynomialOptions = PolynomialOptions()
    ) -> Self:
        """Factorise the normal matrix of a polynomial's pairs, of ``weights`` (n, e)."""
        products = np.argwhere(np.triu(sizes.together >= options.least_mm))
        features = _features(weights, products)
        common = sizes.together[tuple(products.T)]
        ridge = np.concatenate(
            [
                options.ridge / sizes.alone**2,
                options.ridge_cubes / sizes.alone**2,
                options.ridge_products / common**2,
            ]
        )
        return cls(products, np.linalg.cholesky(features.T @ features + np.diag(ridge)))

    def solve(self, right: Floats) -> Floats:
        """Return (F^T F + R)^-1 times ``right`` (2 e + p, r)."""
        return np.asarray(scipy.linalg.cho_solve((self.root, True), right))

    def __call__(self, weights: Floats) -> Floats:
        """Return f . (F^T F + R)^-1 f (n,) of the features f of ``weights`` (n, e)."""
        features = _features(weights, self.products)
        along = scipy.linalg.solve_triangular(self.root, features.T, lower=True)
        return np.asarray(np.sum(along**2, axis=0))


def _features(weights: NDArray[np.floating], products: Ints) -> NDArray[np.floating]:
    first, second = products.T
    both = weights[..., first] * weights[..., second]
    return np.concatenate([weights, weights**3, both], axis=-1)


@dataclass(frozen=True)
class NetworkOptions:
    """Layers, and their training by Adam (Kingma and Ba 2015)."""

    layers: tuple[int, ...] = (512,)  # of ReLU
    epochs: int = 100
    batch: int = 64
    rate: float = 3e-3  # of learning, at first; it falls to nothing along half a cosine
    momentum: float = 0.9
    second_momentum: float = 0.999
    decay: float = 1e-5  # of the weights
    on_linear: bool = True  # whether the network learns what a linear map leaves


# layers and training of the published network
PUBLISHED = NetworkOptions(
    layers=(100, 100, 100, 100), epochs=100, batch=32, rate=0.01, decay=0.0, on_linear=False
)


@dataclass(frozen=True, eq=False)
class Network:
    """y = B c + N(s c) - N(0), N being layers of ReLU and a linear one, s the shapes' sizes.

    ``linear`` (e, r) is B, ``sizes`` (e,) are s, and ``layers`` the (W, b) of N.
    """

    linear: Singles
    sizes: Singles
    layers: tuple[tuple[Singles, Singles], ...]

    @classmethod
    def learn(
        cls,
        weights: Floats,
        goals: Floats,
        sizes: ShapeSizes,
        seed: int = 0,
        options: NetworkOptions = NetworkOptions(),
        listen: Listen = lambda _done: None,
    ) -> Self:
        """Learn from weights (n, e) and their coordinates (n, r): B first, then N of the rest."""
        random = np.random.default_rng(seed)
        scale = sizes.alone / sizes.alone.mean()
        linear = np.linalg.lstsq(weights, goals, rcond=None)[0] * float(options.on_linear)
        inputs = np.asarray(weights * scale, np.float32)
        outputs = np.asarray(goals - weights @ linear, np.float32)
        unit = np.float32(np.sqrt(np.mean(outputs**2))) or np.float32(1.0)
        outputs /= unit
        numbers = [weights.shape[1], *options.layers, goals.shape[1]]
        values = Values()
        for ins, outs in pairwise(numbers):
            spread = np.sqrt(2.0 / ins) * random.standard_normal((ins, outs))
            values += [np.asarray(spread, np.float32), np.zeros(outs, np.float32)]
        adam = _Adam(values, options)
        batches = -(-len(inputs) // options.batch)
        for epoch in range(options.epochs):
            order = random.permutation(len(inputs))
            for number, rows in enumerate(np.array_split(order, batches)):
                done = (epoch + number / batches) / options.epochs
                gradients = _gradients(adam.values, inputs[rows], outputs[rows])
                adam.step(gradients, options.rate * 0.5 * (1.0 + np.cos(np.pi * done)))
            listen((epoch + 1) / options.epochs)
        values[-2:] = [unit * values[-2], unit * values[-1]]
        layers = tuple(zip(values[::2], values[1::2], strict=True))
        return cls(linear.astype(np.float32), scale.astype(np.float32), layers)

    def __call__(self, weights: NDArray[np.floating]) -> Singles:
        """Return the coordinates (..., r) of weights (..., e)."""
        c = weights.astype(np.float32)
        return np.asarray(c @ self.linear + self._whole(c * self.sizes) - self._at_rest)

    @cached_property
    def _at_rest(self) -> Singles:
        return self._whole(np.zeros(len(self.sizes), np.float32))

    def _whole(self, values: Singles) -> Singles:
        for matrix, shift in self.layers[:-1]:
            values = np.maximum(values @ matrix + shift, np.float32(0.0))
        matrix, shift = self.layers[-1]
        return np.asarray(values @ matrix + shift)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what a file has of it."""
        named: dict[str, NDArray[Any]] = {"linear": self.linear, "sizes": self.sizes}
        for number, (matrix, shift) in enumerate(self.layers):
            named[f"matrix_{number}"] = matrix
            named[f"shift_{number}"] = shift
        return named

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Return what :meth:`arrays` gave."""
        rows = range(sum(name.startswith("matrix_") for name in arrays))
        layers = tuple((arrays[f"matrix_{row}"], arrays[f"shift_{row}"]) for row in rows)
        return cls(arrays["linear"], arrays["sizes"], layers)


Values = list[Singles]  # W and b of each layer, one after the other


def _gradients(values: Values, inputs: Singles, goals: Singles) -> Values:
    """Return the derivatives by ``values`` of half the mean squared error of N(inputs) - N(0)."""
    at_rest = np.zeros((1, inputs.shape[1]), inputs.dtype)
    seen: Values = [np.concatenate([inputs, at_rest])]
    for matrix, shift in zip(values[:-2:2], values[1:-2:2], strict=True):
        seen.append(np.maximum(seen[-1] @ matrix + shift, 0.0))
    outputs = seen[-1] @ values[-2] + values[-1]
    error = (outputs[:-1] - outputs[-1] - goals) / goals.size
    error = np.concatenate([error, -error.sum(axis=0, keepdims=True)])
    found: Values = []
    for number in range(len(seen) - 1, -1, -1):
        found[:0] = [np.asarray(seen[number].T @ error, np.float32), error.sum(axis=0)]
        error = (error @ values[2 * number].T) * (seen[number] > 0.0)
    return found


@dataclass
class _Adam:
    values: Values
    options: NetworkOptions
    count: int = 0
    first: Values = field(default_factory=list)
    second: Values = field(default_factory=list)

    def step(self, gradients: Values, rate: float) -> None:
        given = self.options
        if not self.count:
            self.first = [np.zeros_like(each) for each in self.values]
            self.second = [np.zeros_like(each) for each in self.values]
        self.count += 1
        for value, slope, first, second in zip(
            self.values, gradients, self.first, self.second, strict=True
        ):
            slope += given.decay / slope.size * value
            first += (1.0 - given.momentum) * (slope - first)
            second += (1.0 - given.second_momentum) * (slope**2 - second)
            unbiased = np.sqrt(second / (1.0 - given.second_momentum**self.count))
            pace = np.float32(rate / (1.0 - given.momentum**self.count))
            value -= pace * first / (unbiased + np.float32(1e-12))
