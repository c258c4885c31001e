"""Any Co-Simulation FMU as the plant's car. The export of FMUs is in :mod:`bayesrace.codegen.fmu`.

From the file to the car: ``inspection`` (the FMU's variables, and a map of them to fill in) and
what the user says of them meet in ``map``, which makes the ``wiring``. ``simulator`` drives the FMU
by it, through ``host``: the FMU runs in a ``worker`` process, and its failure is a
:class:`bayesrace.plant.vehicle.FmuFault`.
"""
