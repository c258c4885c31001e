"""The public Python interface, of which ``bayesrace/__init__.py`` names what is public.

:mod:`.values` has states and inputs, :mod:`.controller` the controller that is stepped by hand,
:mod:`.simulator` the car, :mod:`.runs` the closed loop of both, :mod:`.training` what is learned
from it; :mod:`.mpc` steps a control problem of one's own, :mod:`.logs` opens a recording,
:mod:`.gym` is the environment for learned policies and :mod:`.testing` the plugin for pytest.

All of it is a thin layer: controllers, cars and closed loop are those of the command line.
"""
