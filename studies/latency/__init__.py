"""``bayesrace latency``: the legs of a control cycle, computed from the log of a run.

All times are in the messages. A measurement records a run and computes the legs afterwards, by the
same code whether the run was started here, was driven elsewhere, or was recorded earlier.

In the order of use: ``settings``; ``measure`` records the run, with the processes of ``beside``.
``legs`` reads the log, joins the messages of a cycle, relates the clocks of plant and controller,
and counts messages. ``analysis`` makes the result, which ``report`` shows.
"""
