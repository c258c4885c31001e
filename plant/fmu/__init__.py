"""Any Co-Simulation FMU as the plant's car. The export of FMUs is in :mod:`codegen.fmu`.

From the file to the car: ``inspection`` (the FMU's variables; ``units``) and ``map_file`` (what the
user says of them) meet in ``map`` (``checks`` for each entry), which makes the ``wiring``.
``simulator`` drives the FMU by it, through ``host``: the FMU runs as an ``instance`` in a
``worker``, a ``process`` whose ``output`` is bounded; its failure is a fault (``faults``).
``proposal`` guesses a map to start from.
"""
