"""``bayesrace replay``: recorded drives once more, by any controller.

:mod:`.recording` reads what each controller process was told, :mod:`.controller` says by what it is
answered again, :mod:`.hosts` answers it, :mod:`.comparison` compares, and :mod:`.run` does so for
all drives.
"""
