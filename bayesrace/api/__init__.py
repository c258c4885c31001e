"""The public Python interface, of which ``bayesrace/__init__.py`` names what is public.

:mod:`.values` has states and inputs, :mod:`.controller` the controller that is stepped by hand,
:mod:`.simulator` the car, :mod:`.runs` the closed loop of both, :mod:`.training` what is learned
from it; :mod:`.mpc` steps a control problem of one's own, :mod:`.logs` opens a recording, and
:mod:`.systems` drives a plant and a controller process for :mod:`bayesrace.testing`.

All of it is a thin layer: controllers, cars and closed loop are those of the command line.
"""
