"""Training a small MLP on a CPU: forward and back in cooperative vectors, weight gradients as matrix products.

Dr.Jit offers two ways to differentiate an MLP. Its tensor mode is a chain of matrix products that goes through memory
after each layer, and for matrices as narrow as these a CPU spends as long on packing them as on multiplying. Its
cooperative vectors run all layers in the registers of one kernel, but add up weight gradients entry by entry. This does
each where it is good.
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

    `packed` is a function without arguments that gives the layers of the same MLP, packed for cooperative vectors, and
    the number of inputs that the first of them takes; the second takes the others, and adds to the first.
    """

    def eval(self, inputs, parameters, packed):
        self.parameters = list(parameters)
        self.inputs = list(inputs)
        (self.first, self.second, *self.layers), self.n_first = packed()
        x = self.first(nn.CoopVec(*self.inputs[: self.n_first]))
        if len(self.inputs) > self.n_first:
            x = x + self.second(nn.CoopVec(*self.inputs[self.n_first :]))
        self.seen = []  # inputs of `layers`
        for layer in self.layers:
            self.seen.append(list(x))
            x = layer(x)
        return list(x)

    def backward(self):
        δ, factors = list(self.grad_out()), []  # of each product: rows of inputs, rows of δ, their columns
        for layer, x in zip(reversed(self.layers), reversed(self.seen), strict=True):
            if isinstance(layer, nn.Linear):
                factors.append((_rows([*x, mi.Float(1)]), _rows(δ), len(x), len(δ)))
                δ = _back(layer, δ)
            else:
                leak = getattr(layer, "negative_slope", 0)
                δ = [dr.select(v > 0, d, leak * d) for d, v in zip(δ, x, strict=True)]
        factors.append((_rows([*self.inputs, mi.Float(1)]), _rows(δ), len(self.inputs), len(δ)))
        back = _back(self.first, δ)
        if len(self.inputs) > self.n_first:
            back += _back(self.second, δ)
        dr.eval(back)  # in one kernel with the rows of all products
        self.set_grad_in("inputs", back)

        gradients, names = {}, iter(self.parameters)
        for x, δ, n_in, n_out in reversed(factors):
            # Few outputs go first: they are one block of rows, instead of one column of blocks
            product = dr.matmul(δ, x, At=True) if δ.shape[1] <= PAD else dr.matmul(x, δ, At=True)
            per_input, per_output = (1, x.shape[1]) if δ.shape[1] <= PAD else (δ.shape[1], 1)
            i, j = dr.arange(mi.UInt32, n_in * n_out) % n_in, dr.arange(mi.UInt32, n_in * n_out) // n_in
            weights = dr.gather(mi.Float, product.array, i * per_input + j * per_output)
            bias = n_in * per_input + dr.arange(mi.UInt32, n_out) * per_output
            bias = dr.gather(mi.Float, product.array, bias)
            gradients |= {next(names): mi.TensorXf(weights, (n_out, n_in)), next(names): mi.TensorXf(bias)}
        self.set_grad_in("parameters", gradients)

    def name(self):
        return "perceptron"


def _back(layer, δ: list) -> list:
    return list(nn.matvec(layer.weights, nn.CoopVec(*δ), transpose=True))


def _rows(columns: list):
    """A matrix of which `columns` are the columns, padded with columns of 0 to a multiple of `PAD`."""
    n = dr.width(columns)
    width = -(-len(columns) // PAD) * PAD
    columns = [*columns, *[mi.Float(0)] * (width - len(columns))]
    rows = dr.empty(mi.Float, n * width)
    dr.scatter(rows, dr.detach(mi.ArrayXf(columns)), dr.arange(mi.UInt32, n))
    return mi.TensorXf(rows, (n, width))
