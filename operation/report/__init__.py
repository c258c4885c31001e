"""The report of a race: one self-contained HTML file, and one picture. Imports matplotlib."""

from operation.report.render import render_report

__all__ = ["render_report"]
