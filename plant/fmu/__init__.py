"""An FMU of another tool as the car, and the car as an FMU for other tools (``export``).

From the file to the car: ``inspection`` (the FMU's variables; ``units``) and ``map_file`` (what the
user says of them) meet in ``map`` (``checks`` for each entry), which makes the ``wiring``.
``simulator`` drives the FMU by it, through ``host``: the FMU runs as an ``instance`` in a
``worker``, a ``process`` whose ``output`` is bounded; its failure is a fault (``faults``).
``proposal`` guesses a map to start from.
"""
