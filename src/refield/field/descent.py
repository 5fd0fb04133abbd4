"""How a hash field's parameters follow their gradients."""

from __future__ import annotations

import math

import torch

from refield.field import kernels
from refield.field.encoding import large_zeros
from refield.field.radiance import HashField

MOST_SKIPPED = 20  # steps in a row


class NonFiniteError(RuntimeError):
    """The loss or its gradient stayed infinite or NaN for too long."""

    field: HashField | None = None
    """the last good state, ready for use, where `fit.fit_field` raises this"""
    steps: int = 0
    """that were taken before"""


class TableAdam:
    """Adam for a hash field: what has no gradient rests, in the tables as in the matrices."""

    def __init__(self, model: HashField) -> None:
        self.parameters = [model.encoding.tables, *model.networks]
        self.grads = [large_zeros(*p.shape) for p in self.parameters]
        """where a step's gradients are added up; cleared by :meth:`step`"""
        self.first, self.second = ([large_zeros(*p.shape) for p in self.parameters] for _ in range(2))
        self.count = 0
        self.left_out = 0
        """steps since the last that was taken"""

    def step(self, rate: float, loss: float) -> bool:
        """Take the step if the loss and its gradients are finite; else leave it out, and count it.

        Raises:
            NonFiniteError: that was the 20th in a row; the parameters are as the last sound step left them.
        """
        # a gradient that is not finite shows in the networks', through which all of it has gone
        if not math.isfinite(loss) or not all(bool(g.isfinite().all()) for g in self.grads[1:]):
            self.left_out += 1
            for grad in self.grads:
                grad.zero_()
            if self.left_out >= MOST_SKIPPED:
                error = NonFiniteError(f"the loss or its gradient was not finite for {MOST_SKIPPED} steps in a row")
                error.steps = self.count
                raise error
            return False
        self.count, self.left_out = self.count + 1, 0
        with torch.no_grad():
            for p, grad, first, second in zip(self.parameters, self.grads, self.first, self.second):
                kernels.adam(p, grad, first, second, rate, self.count)
        return True
