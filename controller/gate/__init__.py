"""What new weights have to pass before, and after, a running controller drives with them.

Pure parts: :mod:`.judge` (the checks), :mod:`.samples`, :mod:`.model`, :mod:`.store`; and the way
between the controller and its gatekeeper process: :mod:`.memory`, :mod:`.channel`, :mod:`.launch`,
:mod:`.link`, :mod:`.supervisor`.
"""
