"""The Gaussian-process (GP) residual, from the file to the corrected model.

:mod:`.weights` holds what training found, as data and as a file; :mod:`.expression` evaluates the
posterior mean of these data (CasADi, NumPy) and adds it to the nominal model.
"""
