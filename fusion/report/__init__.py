"""The report: one page that works offline, on which a person sees how good a run is, where it is bad and why."""

from fusion.report.content import ReportContent, Thumbnail, content_of
from fusion.report.page import write_report

__all__ = ["ReportContent", "Thumbnail", "content_of", "write_report"]
