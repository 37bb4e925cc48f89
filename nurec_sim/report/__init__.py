"""The report of a run: one HTML file that opens without a server or a network.

``render_report(RunReport) -> str`` is all of it; ``nurec_sim.runs`` gathers what goes in and writes the file.
"""

from nurec_sim.report.data import Comparison, ReportRollout, ReportScene, RunReport, Video
from nurec_sim.report.page import render_report

__all__ = ["Comparison", "ReportRollout", "ReportScene", "RunReport", "Video", "render_report"]
