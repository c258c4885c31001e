"""The report of a race: one self-contained HTML file. Imports matplotlib."""

from bayesrace.operation.report.render import write_report

__all__ = ["write_report"]
