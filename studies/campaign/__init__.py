"""``bayesrace campaign``: thousands of laps over a grid or a sample of settings, by Dask.

In the order of use: ``plan`` reads the TOML file and makes its ``case``s, each with a key that
changes with everything that shapes its result; a worker drives it. ``campaign`` starts workers or
finds them, and hands them the cases that ``results`` does not hold yet. ``results`` keeps one row a
lap in Parquet, of which ``report`` makes tables and a page. ``tune`` searches for better settings
by the same workers.
"""
