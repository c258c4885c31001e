"""Offline learning: from recorded drives to validated weights of the GP residual.

In the order of use:

1. :mod:`.dataset` holds one-step samples and filters them. :mod:`.arrays` reads them from plain
   arrays, :mod:`.logs` from run logs, :mod:`.sources` from any mixture of both.
2. :mod:`.residual` computes what the nominal model misses.
3. :mod:`.likelihood` and :mod:`.hyperparameters` find a GP's hyperparameters, :mod:`.subset` the
   samples that it keeps; :mod:`.posterior` predicts with it.
4. :mod:`.folds` cuts a drive for cross-validation, :mod:`.scores` rates predictions,
   :mod:`.target` kernels and choices of samples.
5. :mod:`.training` puts these together; :mod:`.trainer` does so lap by lap, in another process.
6. :mod:`.validation` compares weights with another drive.
7. :mod:`.search` is apart: it finds the minimum of a costly function, such as a lap by its line.
"""
