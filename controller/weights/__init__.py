"""New weights for a running controller: checked, adopted between two cycles, watched, stored.

The modules in the order in which a weights file passes them:

1. :mod:`.manager` receives it, takes it through all further steps in a thread of its own, answers.
2. :mod:`.checks` decodes and checks it in another process.
3. :mod:`.adoption` exchanges the weights in the control thread, between two cycles, and does what
   the watch says: the compiled controller keeps and compares both (controller/native/br_watch.c,
   br_trial.c), so that going back is an exchange, too. Of a controller that is elsewhere
   :mod:`bayesrace.controller.remote_weights` takes its place.
4. :mod:`.store` keeps what has been accepted.

:class:`bayesrace.controller.settings.GateSettings` has the thresholds.
"""
