"""The report of a recording: one HTML file without external resources, and the PDF that is printed from it.

``recorded`` and ``investigation_chapter`` read the data, ``document_status`` decides between certificate, specimen and
report, a module in ``chapters`` prepares each chapter, ``document`` fills the templates and ``pdf`` prints them.
"""
