"""`backprop.Perceptron`: the gradients of Dr.Jit's tensor mode, whatever the sizes, and in a frozen function."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_neural.caches.weights import FieldShape, Weights

# Widths that are no multiple of anything, a part of the inputs known before, leaking rectifiers, one hidden layer
SHAPES = {
    "nirc": FieldShape(hashmap_size=2**8),
    "odd": FieldShape(n_levels=3, hashmap_size=2**8, direction_degree=1, width=13, n_hidden=3, n_outputs=5, leak=0.1),
    "position": FieldShape(n_levels=4, hashmap_size=2**8, direction_degree=-1, width=8, n_hidden=1, n_outputs=1),
}
N = 1000


def gradients(weights, inputs, by_tensors: bool):
    """Outputs, and the gradients of a function of them that treats no two alike."""
    for v in (*inputs, *weights.mlp.values()):
        dr.enable_grad(v)
    if by_tensors:
        out = weights.mlp(mi.TensorXf(dr.concat(inputs), (len(inputs), N)))
        out = [out[k, :].array for k in range(out.shape[0])]
    else:
        out = weights.differentiable(inputs)
    loss = sum(dr.square(v - 0.3 * k) for k, v in enumerate(out))
    dr.backward(loss)
    found = [np.array(dr.detach(v)) for v in out]
    found += [np.array(dr.grad(v)).ravel() for v in (*inputs, *weights.mlp.values())]
    for v in (*inputs, *weights.mlp.values()):
        dr.disable_grad(v)
    return found


@pytest.mark.parametrize("name", SHAPES)
def test_outputs_and_gradients_are_those_of_the_tensors(name):
    weights, rng = Weights(SHAPES[name], 1), np.random.default_rng(0)
    for k, v in weights.mlp.items():  # biases start at 0, which would hide them
        weights.mlp[k] = v + mi.TensorXf(rng.normal(0, 0.1, v.shape).astype(np.float32))
    inputs = [mi.Float(rng.normal(size=N).astype(np.float32)) for _ in range(SHAPES[name].n_inputs)]
    ours, theirs = (gradients(weights, inputs, by_tensors) for by_tensors in (False, True))
    for a, b in zip(ours, theirs, strict=True):
        scale = np.abs(b).max()
        assert scale > 0
        np.testing.assert_allclose(a, b, atol=1e-5 * scale)
