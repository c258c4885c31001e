"""Any Co-Simulation FMU as the plant's car. The export of FMUs is in :mod:`codegen.fmu`."""
