"""The report of a recording: one HTML file that needs nothing else, and the PDF that a browser prints of it.

``recorded`` and ``traced`` read what it is drawn from, ``standing`` says what the document may call itself; a module
for each chapter or two writes the HTML, ``document`` puts it together, ``browser`` prints.
"""
