"""One self-contained page per visit, and one for a scene's whole history: what changed, in words, a plan, photos.

Built from plain facts and pictures, so that whoever joins the stages decides what to show.
"""

from refield.report.pictures import write_contact_sheet
from refield.report.scene_history import PastVisit, history_page
from refield.report.visit import Comparison, VisitReport, object_shift, summary, turn, visit_report_dict
from refield.report.write import PAGE, is_our_page, link_next, write_report

__all__ = [
    "PAGE",
    "Comparison",
    "PastVisit",
    "VisitReport",
    "history_page",
    "is_our_page",
    "link_next",
    "object_shift",
    "summary",
    "turn",
    "visit_report_dict",
    "write_contact_sheet",
    "write_report",
]
