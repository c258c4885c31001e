"""The estimator in C (bayesrace_estimator.h) by itself, without a control cycle around it."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.controller.estimator import Belief, Measurement, fill, read
from bayesrace.controller.native_step import NativeProblem
from bayesrace.errors import InputError

__all__ = ["Estimator"]


class Estimator:
    """An extended Kalman filter over the model and the weights of a step; for its thread."""

    def __init__(self, step: NativeProblem, settings: Mapping[str, Any]) -> None:
        """``settings``: a br_estimation by name; InputError if unusable."""
        self._artefact = artefact = step.artefact
        self._step = step  # its memory has to stay
        self._library, self._ffi, self._check = artefact.library, artefact.ffi, artefact.check
        size = self._library.br_estimator_memory_size()
        self._memory, handle = artefact.memory(size), self._ffi.new("br_estimator **")
        error = self._library.br_estimator_init(self._memory, size, step.handle, handle)
        self._check(error, "estimator")
        self.handle: Final = handle[0]
        error = self._library.br_estimator_set(
            self.handle, self._ffi.new("br_estimation *", dict(settings))
        )
        self._check(error, "estimator's settings")
        self._belief = self._ffi.new("br_belief *")

    def advance(
        self,
        time_s: float,
        u: Floats,
        residual: tuple[Floats, Floats, Floats],
        measured: Sequence[Measurement],
    ) -> bool:
        """The period that ends at ``time_s`` is over; whether anything is known yet.

        ``u`` (nu,) acted in it; ``residual``: its variance (ne,), per stage, that of its noise, and
        the terms of its mismatch (nphi,). InputError for a time before the last one.
        """
        given = self._ffi.new("br_measurement[]", len(measured))
        fill(given, measured)
        acted = self._ffi.from_buffer("double[]", np.ascontiguousarray(u, dtype=np.float64))
        known = self._ffi.new("br_residual *", [one.tolist() for one in residual])
        error = self._library.br_estimator_advance(
            self.handle, time_s, acted, known, given, len(measured)
        )
        if error == self._library.BR_ERROR_NOT_READY:
            return False
        self._check(error, "estimator")
        return True

    def correct(self, weight: Floats, covariance: Floats | None = None) -> None:
        """Weights (ne, nphi) of the mismatch from now on, and each output's (nphi, nphi)."""
        given = self._ffi.new("br_mpc_mismatch *")
        given.phi[0] = 1.0
        given.weight = weight.tolist()
        if covariance is not None:
            roots = np.linalg.cholesky(np.linalg.inv(covariance))
            for root in roots:
                np.fill_diagonal(root, 1 / np.diag(root))
            given.factor = roots.tolist()
        self._check(self._library.br_estimator_correct(self.handle, given), "mismatch")

    def shown(self) -> tuple[Floats, Floats, Floats, float]:
        """What the last period has shown of the mismatch: information (ne, nphi, nphi), projection
        (ne, nphi), squares (ne,), and of how many values."""
        self.read()
        noise = self._belief.noise
        information, projection, squares = (
            np.frombuffer(self._ffi.buffer(one), float).copy()
            for one in (noise.information, noise.projection, noise.squares)
        )
        rows = projection.reshape(len(squares), -1)
        return information.reshape(*rows.shape, -1), rows, squares, noise.values

    def read(self) -> Belief:
        """At the end of the last period; InputError while nothing is known."""
        belief = read(self._artefact, self.handle, self._belief)
        if belief is None:
            raise InputError("estimator: no position and heading have been measured yet")
        return belief

    def instrument(self, number: int) -> Any:
        """What has become of an instrument's measurements: a br_instrument."""
        return self._library.br_estimator_instrument(self.handle, number)
