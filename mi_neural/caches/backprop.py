"""Training a small MLP on a CPU: forward and back in cooperative vectors, weight gradients as matrix products.

Dr.Jit offers two ways to differentiate an MLP. Its tensor mode is a chain of matrix products that goes through memory
after each layer, and on a CPU its products are compiled for the oldest processors. Its cooperative vectors run all
layers in the registers of one kernel, but add up weight gradients entry by entry. This does each where it is good.
"""

from __future__ import annotations

import drjit as dr
import drjit.nn as nn
import mitsuba as mi

#: Rows of the matrices of activations are padded to multiples of this: what Dr.Jit scatters as packets, and the height
#: of the blocks of its matrix product.
PAD = 4


class Perceptron(dr.CustomOp):
    """Outputs of an MLP (list of floats) from its `inputs` (list of floats), with gradients for these and for its
    `parameters`, a dictionary of tensors.

    `layers` is a function without arguments that gives the layers of the same MLP, packed for cooperative vectors;
    their order is that of `parameters`, weights before bias.
    """

    def eval(self, inputs, parameters, layers):
        self.parameters = list(parameters)
        self.steps = []  # (layer, its input)
        x = list(inputs)
        for layer in layers():
            self.steps.append((layer, x))
            x = list(layer(nn.CoopVec(*x)))
        return x

    def backward(self):
        δ, products = self.grad_out(), []
        for k in reversed(range(len(self.steps))):
            layer, x = self.steps[k]
            if isinstance(layer, nn.Linear):
                products.append((_rows([*x, mi.Float(1)]), len(x), _rows(δ), len(δ)))
                δ = list(nn.matvec(layer.weights, nn.CoopVec(*δ), transpose=True))
            else:
                δ = [d * dr.select(v > 0, 1, getattr(layer, "negative_slope", 0)) for d, v in zip(δ, x, strict=True)]
        dr.eval(δ)  # one kernel, with the rows of all products
        self.set_grad_in("inputs", δ)
        gradients = {}
        names = iter(self.parameters)
        for x, n_in, d, n_out in reversed(products):
            product = dr.matmul(x, d, At=True)
            width = product.shape[1]
            i, j = dr.meshgrid(dr.arange(mi.UInt32, n_in), dr.arange(mi.UInt32, n_out), indexing="xy")
            gradients[next(names)] = mi.TensorXf(dr.gather(mi.Float, product.array, i * width + j), (n_out, n_in))
            j = dr.arange(mi.UInt32, n_out)
            gradients[next(names)] = mi.TensorXf(dr.gather(mi.Float, product.array, n_in * width + j))
        self.set_grad_in("parameters", gradients)

    def name(self):
        return "perceptron"


def _rows(columns: list):
    """A matrix of which `columns` are the columns, padded with columns of 0 to a multiple of `PAD`."""
    n = dr.width(columns)
    width = -(-len(columns) // PAD) * PAD
    columns = [*columns, *[mi.Float(0)] * (width - len(columns))]
    rows = dr.empty(mi.Float, n * width)
    dr.scatter(rows, dr.detach(mi.ArrayXf(columns)), dr.arange(mi.UInt32, n))
    return mi.TensorXf(rows, (n, width))
