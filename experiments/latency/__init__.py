"""``bayesrace latency``: the legs of a control cycle, computed from the log of a run.

All times are in the messages. A measurement therefore records a run and computes the legs
afterwards, by the same code whether the run was started here, was running elsewhere, or was
recorded earlier.

In the order of use: ``settings``; ``measure`` starts or attaches to a plant and a controller and
records them, with ``bare_loop`` and ``load`` as processes beside them. ``columns`` reads a log into
arrays. ``clocks`` relates the clock of the controller to that of the plant, ``legs`` joins the
messages of a cycle, ``traffic`` counts the messages, and ``series`` gives percentiles and
histogram logs. ``analysis`` puts these together to the ``results``; ``report`` and ``plot`` show
them.
"""
