"""``bayesrace paper``: every figure and number of the paper, made from scratch, on one page.

In the order of use: ``settings`` is what is asked for; ``make`` makes the sections, of which
``models`` and ``loop`` have the largest, and writes the page. ``orca.json`` and ``f1tenth.json``
are the settings by which all of it is made. ``experiment`` prepares a car, drives its laps, puts a
published result beside ours and derives from a criterion whether they agree. What takes long is
kept in the cache, so that a run that was interrupted goes on where it was.
"""
