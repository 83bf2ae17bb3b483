"""The network of `swarmsim.site.wall_network` as one kernel of a GPU: what is between its layers stays on the chip.

XLA writes the units of each layer to memory and reads them again, several times as many numbers as there are features
and outputs together. Products have operands of three TF32 parts each, and with that the precision of float32.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

COLUMNS = 64  # of a block
_WARPS = 4
_LEAST = 16  # rows of a matrix that a tensor core multiplies
_EXACT = lax.DotAlgorithmPreset.TF32_TF32_F32_X3


def suits(features: jax.Array) -> bool:
    """Whether the columns of features [inputs, n] are whole blocks."""
    return features.shape[1] > 0 and features.shape[1] % COLUMNS == 0


def evaluated(
    features: jax.Array, weights: Sequence[Any], biases: Sequence[Any], *, interpret: bool = False
) -> jax.Array:
    """Outputs [outputs, n] of features [inputs, n] within their range, n being what `suits`.

    ``weights`` and ``biases`` are those of `swarmsim.site.wall_network.Network`. There are no derivatives. With
    ``interpret`` the kernel runs without a GPU, for tests.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    inputs, n = features.shape
    heights = [_height(inputs), *(_height(len(b)) for b in biases)]
    layers: list[Any] = []
    for w, b, rows, columns in zip(weights, biases, heights[1:], heights[:-1], strict=True):
        layers += [_filled(w, (rows, columns)), _filled(np.asarray(b)[:, None], (rows, 1))]
    precision = None if interpret else _EXACT

    def kernel(x_ref: Any, *refs: Any) -> None:
        *layers, found = refs
        x = x_ref[...]
        for number, (w, b) in enumerate(zip(layers[::2], layers[1::2], strict=True)):
            if number:
                x = squareplus(x)
            x = jnp.dot(w[...], x, precision=precision, preferred_element_type=jnp.float32) + b[...]
        found[...] = x

    def whole(layer: Any) -> pl.BlockSpec:
        return pl.BlockSpec(layer.shape, lambda _: (0, 0))

    call = pl.pallas_call(
        kernel,
        grid=(n // COLUMNS,),
        in_specs=[pl.BlockSpec((heights[0], COLUMNS), lambda i: (0, i)), *map(whole, layers)],
        out_specs=pl.BlockSpec((heights[-1], COLUMNS), lambda i: (0, i)),
        out_shape=jax.ShapeDtypeStruct((heights[-1], n), jnp.float32),
        interpret=interpret,
        compiler_params=None if interpret else triton.CompilerParams(num_warps=_WARPS, num_stages=1),
    )
    padded = jnp.pad(lax.stop_gradient(features), [(0, heights[0] - inputs), (0, 0)])
    return call(padded, *layers)[: len(biases[-1])]


def squareplus(x: jax.Array) -> jax.Array:
    """What each unit of a hidden layer makes of its sum."""
    return 0.5 * (x + jnp.sqrt(x * x + 1.0))


def _height(rows: int) -> int:
    """The next power of two."""
    return max(_LEAST, 1 << (rows - 1).bit_length())


def _filled(values: Any, shape: tuple[int, int]) -> np.ndarray:
    """Values [rows, columns] with zeros after them."""
    values = np.asarray(values, np.float32)
    return np.pad(values, [(0, whole - part) for whole, part in zip(shape, values.shape, strict=True)])
