"""Does the controller answer in time: ``bayesrace timing``.

:mod:`.problems` finds and times what it has to solve, :mod:`.tail` extrapolates, :mod:`.study`
judges, :mod:`.report` shows.
"""
