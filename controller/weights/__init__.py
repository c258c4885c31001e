"""New weights for a running controller: validated, adopted between two cycles, watched, stored.

The modules in the order in which a weights file passes them:

1. :mod:`.requests` receives it, with one deadline for everything that follows.
2. :mod:`.manager` takes it through all further steps in a thread of its own, and answers.
3. :mod:`.validator` decodes and judges it in another process, which :mod:`.supervisor` starts and
   replaces. :mod:`.checks` compares the predictions of the compiled :mod:`.model` on
   :mod:`.samples` of the :mod:`.states` that the control thread records.
4. :mod:`.adoption` exchanges the weights in the control thread, between two cycles.
5. :mod:`.watch` compares them with earlier ones while the car drives; they stay, or the manager
   rolls back.
6. :mod:`.store` keeps what has been accepted.

:mod:`.settings` has the thresholds.
"""
