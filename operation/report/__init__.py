"""The report of a race: one self-contained HTML file, and one picture. Imports matplotlib."""

from bayesrace.operation.report.render import write_report

__all__ = ["write_report"]
