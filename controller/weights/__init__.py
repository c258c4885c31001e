"""New weights for a running controller: validated, adopted between two cycles, watched, stored.

The modules in the order in which a weights file passes them:

1. :mod:`.manager` receives it, takes it through all further steps in a thread of its own, answers.
2. :mod:`.validator` decodes and judges it in another process, which :mod:`.supervisor` starts and
   replaces and :mod:`.validator_client` talks with. :mod:`.checks` compares the :mod:`.prediction`
   of the compiled model with what the car has done.
3. :mod:`.adoption` exchanges the weights in the control thread, between two cycles, and records
   states. The validator is sent them, and compares the weights with proven ones while the car
   drives; they stay, or the manager slows the car down or rolls back.
4. :mod:`.store` keeps what has been accepted.

:mod:`.settings` has the thresholds.
"""
