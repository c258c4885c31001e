"""Offline learning: from recorded drives to validated weights of the GP residual.

In the order of use:

1. :mod:`.sources` reads one-step samples from run logs and plain arrays; :mod:`.dataset` holds
   and filters them. Where states are to be estimated, :mod:`.drives` holds what was read, and
   :mod:`.smoothing` makes states of it, :mod:`.estimates` samples, and :mod:`.conditioning`
   weights.
2. :mod:`.gaussian_process` predicts with a GP, and finds its hyperparameters.
3. :mod:`.subset` chooses the samples that a GP keeps, and those that cross-validation leaves out.
   :mod:`.target` is one output to learn, and scores predictions of it.
4. :mod:`.symmetry` checks that a car turns left as it turns right, and :mod:`.change` whether it
   has changed, and adapts older samples if so. :mod:`.training` puts these together, also lap by
   lap in another process.
5. :mod:`.validation` computes what the nominal model misses, and compares weights with another
   drive.
6. :mod:`.identification` finds the numbers of a car's file: :mod:`.instruments` reads what was
   measured, :mod:`.window_fit` fits :mod:`.single_track` to it.
7. :mod:`.search` is apart: it finds the minimum of a costly function, such as a lap by its line.
"""
