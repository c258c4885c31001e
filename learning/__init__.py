"""Offline learning: from recorded drives to validated weights of the GP residual.

In the order of use:

1. :mod:`.dataset` holds one-step samples and filters them. :mod:`.logs` reads them from run logs,
   :mod:`.sources` from any mixture of logs and plain arrays.
2. :mod:`.residual` computes what the nominal model misses.
3. :mod:`.posterior` predicts with a GP, :mod:`.likelihood` finds its hyperparameters.
4. :mod:`.subset` chooses the samples that a GP keeps, and those that cross-validation leaves out.
   :mod:`.target` is one output to learn, and scores predictions of it.
5. :mod:`.training` puts these together; :mod:`.trainer` does so lap by lap, in another process.
6. :mod:`.validation` compares weights with another drive.
7. :mod:`.search` is apart: it finds the minimum of a costly function, such as a lap by its line.
"""
