"""How a hash field's parameters follow their gradients."""

from __future__ import annotations

import math

import torch

from refield.field import kernels
from refield.field.encoding import large_zeros
from refield.field.nerfacto import NerfactoField
from refield.field.radiance import HashField

MOST_SKIPPED = 20  # steps in a row


class NonFiniteError(RuntimeError):
    """The loss or its gradient stayed infinite or NaN for too long."""

    field: HashField | NerfactoField | None = None
    """the last good state, ready for use, where the fit of a whole field raises this"""
    steps: int = 0
    """that were taken before"""


FADE_EVERY = 16  # steps: to go through the whole of large tables costs as much as Adam


class TableAdam:
    """Adam for a hash field: what has no gradient rests, in the tables as in the matrices."""

    def __init__(self, model: HashField, decay: float = 0.0, networks: float = 1.0) -> None:
        """``decay``: see `fading`; ``networks``: their learning rate, as a part of the tables'."""
        self.decay, self.networks = decay, networks
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
            rates = [rate, *(self.networks * rate for _ in self.parameters[1:])]
            for p, grad, first, second, each in zip(self.parameters, self.grads, self.first, self.second, rates):
                kernels.adam(p, grad, first, second, each, self.count)
            if self.decay and self.count % FADE_EVERY == 0:
                self.parameters[0].mul_(fading(self.decay, rate))
        return True


def fading(decay: float, rate: float) -> float:
    """What tables are multiplied by every `FADE_EVERY` steps: decoupled weight decay, times the learning rate. Entries
    that rays seldom ask would keep what they were told in passing, and entries that are asked follow more quickly."""
    return max(1 - FADE_EVERY * decay * rate, 0.0)
