"""A run in a browser: while it is driven, or when it is over.

``runs`` turns the messages of a log into what the page shows; ``sources`` finds the log, which may
still be written, of a race or a file; ``network`` records the cars of a network; ``server`` serves
the page and sends it new data; ``page`` is the page, which can also be saved as one file with its
data; ``foxglove`` serves Foxglove and Lichtblick.
"""

from bayesrace.operation.view.network import network_source
from bayesrace.operation.view.page import whole_page
from bayesrace.operation.view.runs import Runs
from bayesrace.operation.view.server import Viewer
from bayesrace.operation.view.sources import Source, run_source

__all__ = ["Runs", "Source", "Viewer", "network_source", "run_source", "whole_page"]
