"""What shadows have decided beside the controller that drove: read, compare, judge, draw.

:mod:`.cycles` reads a log, :mod:`.comparison` makes numbers of it, :mod:`.judgement` checks of
these, :mod:`.picture` a picture.
"""
