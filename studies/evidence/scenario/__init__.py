"""Scenarios: a drive, what happens in it, and what must hold; in simulated time or in real time.

:mod:`.events` is what can happen, :mod:`.description` the TOML file, :mod:`.simulated` and
:mod:`.real` drive it, :mod:`.checks` judges the recording, :mod:`.run` does so with many files, and
:mod:`.report` makes the page. The scenarios that ship are in ``shipped``.
"""
