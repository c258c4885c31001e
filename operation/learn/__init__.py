"""``bayesrace learn``: follows a car that drives, learns from its laps, and publishes weights.

:mod:`.job` reads what is given and runs the event loop: :mod:`.collector` makes laps and samples of
messages, :mod:`bayesrace.learning.training` trains, :mod:`.publishing` sends the weights,
:mod:`.journal` keeps all :mod:`.records` on disk, and :mod:`.report` shows them.
"""
