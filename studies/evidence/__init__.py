"""Evidence about a controller before it drives: commands with a verdict and an exit code.

:mod:`.verdict` is what they share: checks that hold or do not, as a table and as JUnit XML.
"""
