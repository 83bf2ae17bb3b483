"""The network of walls: its table, and what keeps it from telling nonsense."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmsim.radiation.walls import MOST
from swarmsim.site import network_kernel
from swarmsim.site.surfaces import FEATURES, Box
from swarmsim.site.wall_network import COEFFICIENTS, DEPTHS, OUTPUTS, network, network_of, outputs, scattered, table_of


def test_a_table_gives_the_network_that_it_was_made_of():
    net = network()
    again = network_of(table_of(net))
    for one, other in zip(
        (*net[:5], *net.weights, *net.biases), (*again[:5], *again.weights, *again.biases), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-4)


def test_a_table_of_another_shape_is_refused():
    lines = table_of(network()).splitlines()
    last = max(i for i, line in enumerate(lines) if line.startswith("weights0"))
    with pytest.raises(ValueError, match="do not lead from"):
        network_of("\n".join(lines[:last] + lines[last + 1 :]))


def test_its_layers_are_those_of_the_formula():
    net, rng = network(), np.random.default_rng(3)
    features = rng.uniform(net.low, net.high, (40, len(FEATURES))).astype(np.float32)
    x = (features.astype(float) - net.middle) / net.scale
    for number, (weights, biases) in enumerate(zip(net.weights, net.biases, strict=True)):
        if number:
            x = 0.5 * (x + np.sqrt(x * x + 1.0))
        x = x @ weights.T.astype(float) + biases
    np.testing.assert_allclose(outputs(jnp.asarray(features.T)).T, x, atol=2e-3)


def in_kernel(features, **interpreted):
    """Of features [.., FEATURES, n] as they are within their range."""
    net = network()
    x = (features - net.middle[:, None]) / net.scale[:, None]

    def of(x):
        return network_kernel.evaluated(x, net.weights, net.biases, **interpreted)

    return jax.vmap(jax.vmap(of))(x)


def test_its_kernel_computes_the_same():
    """For several missions and places, as in an estimate."""
    net, rng = network(), np.random.default_rng(4)
    shape = (2, 3, 2 * network_kernel.COLUMNS, len(FEATURES))
    features = jnp.asarray(np.swapaxes(rng.uniform(net.low, net.high, shape), 2, 3), jnp.float32)
    found = jax.jit(lambda x: in_kernel(x, interpret=True))(features)
    expected = jax.vmap(jax.vmap(outputs))(features)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)
    assert network_kernel.suits(features[0, 0])
    assert not network_kernel.suits(features[0, 0, :, 1:])
    # what a GPU is given
    lowered = jax.jit(in_kernel).trace(features).lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("__gpu$xla.gpu.triton") == 1


def test_a_gpu_takes_whole_blocks_to_the_kernel(monkeypatch):
    """Of the project's network; another one, which may be a traced one that is fitted, goes the other way."""
    net, rng, taken = network(), np.random.default_rng(5), []
    evaluated = network_kernel.evaluated

    def interpreted(x, weights, biases):
        taken.append(x.shape[1])
        return evaluated(x, weights, biases, interpret=True)

    whole = 2 * network_kernel.COLUMNS
    # some of them beyond its range
    features = jnp.asarray(rng.uniform(net.low, 1.5 * net.high, (whole, len(FEATURES))).T, jnp.float32)
    expected = outputs(features)
    monkeypatch.setattr(network_kernel, "evaluated", interpreted)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    np.testing.assert_allclose(outputs(features), expected, rtol=1e-4, atol=1e-3)
    assert taken == [whole]
    for found in (
        outputs(features, net),
        jnp.concatenate([outputs(features[:, :1]), outputs(features[:, 1:])], axis=1),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)
    assert taken == [whole]


def test_what_is_beyond_all_that_it_was_fitted_to_is_as_at_the_end():
    net = network()
    beyond = net.high + 1e3 * (net.high - net.low)
    ends, found = (outputs(jnp.asarray(x, jnp.float32)[:, None]) for x in (net.high, beyond))
    np.testing.assert_array_equal(ends, found)


@pytest.mark.slow
def test_no_building_scatters_out_of_all_proportion():
    """Of a hundred thousand lines at random, through walls up to the depth that is fitted to."""
    rng, n = np.random.default_rng(5), 100_000
    half = np.exp(rng.uniform(np.log(0.2), np.log(20.0), (n, 3)))
    wall = np.where(rng.random(n) < 0.3, 0.0, np.exp(rng.uniform(np.log(0.001), np.log(0.4), n)))
    start, end = (rng.normal(size=(n, 3)) * np.exp(rng.uniform(-1.0, 4.0, (n, 1))) for _ in range(2))
    begins, ends, halves = (list(jnp.asarray(x.T, jnp.float32)) for x in (start, end, half))
    found, around = scattered(Box(begins, ends, halves, jnp.asarray(wall, jnp.float32)))
    found = np.asarray(found)[:, np.asarray(around.thin_m) > 1e-4].reshape(len(DEPTHS), COEFFICIENTS, -1)
    assert len(DEPTHS) * COEFFICIENTS == OUTPUTS
    for level, growth in ((-2.0, 0.3), (0.0, 1.0), (0.7, 1.5)):
        share = found[:, 0] + found[:, 1] * level + found[:, 2] * (growth - 1.0)
        assert np.isfinite(share).all()
        # more than can be, with a growth of 0: next to never, and `swarmsim.radiation.walls` does not believe it
        highest = np.log(MOST) + np.array(DEPTHS) - np.log(DEPTHS)
        assert np.mean(share > highest[:, None]) < 0.01
