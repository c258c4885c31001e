"""New weights for a running controller: checked, adopted between two cycles, watched, stored.

The modules in the order in which a weights file passes them:

1. :mod:`.manager` receives it, takes it through all further steps in a thread of its own, answers.
2. :mod:`.judge` is another process that decodes it and runs the :mod:`.checks`.
3. :mod:`.adoption` exchanges the weights in the control thread, between two cycles, and lets the
   :mod:`.watch` compare them with the proven ones while the car drives: the compiled controller
   keeps both (controller/native/br_watch.c), so that going back is an exchange, too.
4. :mod:`.store` keeps what has been accepted.

:mod:`.settings` has the thresholds.
"""
