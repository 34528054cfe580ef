"""Prints a report: PDF/A-3b of its HTML, the same bytes for the same report."""

import warnings
from pathlib import Path

from drivers.packaged import packaged_text
from station.atomic_write import write_whole
from station.errors import UsageError, sentence


def print_pdf(html: str, pdf: Path) -> bytes:
    """Print the report ``html`` as PDF/A-3b (ISO 19005-3) with matplotlib's fonts, write it to ``pdf``, and return it.

    Only data URIs and these fonts are loaded; anything else is left out. UsageError if WeasyPrint or Pango is not
    installed, or if ``pdf`` exists or cannot be written.
    """
    try:
        with warnings.catch_warnings():
            # Without this library WeasyPrint subsets fonts by fontTools, as well.
            warnings.filterwarnings("ignore", "HarfBuzz-Subset", DeprecationWarning)
            from weasyprint import HTML
            from weasyprint.urls import URLFetcher
    except (ImportError, OSError) as error:
        raise UsageError(sentence("report.no_pdf", why=str(error).splitlines()[0])) from None
    from matplotlib import get_data_path

    folder = Path(get_data_path(), "fonts", "ttf").as_uri()
    sheet = packaged_text("station.report", "print.css").replace("FONTS", folder)

    class Fonts(URLFetcher):  # type: ignore[misc]
        def fetch(self, url: str, headers: object = None) -> object:
            if url.startswith("data:") or f"url({url})" in sheet:
                return super().fetch(url, headers)
            raise ValueError(f"{url} is referenced by a picture; pictures must not refer to hosts or files")

    document = HTML(string=html.replace("</style>", f"{sheet}</style>", 1), url_fetcher=Fonts())
    content = bytes(document.write_pdf(pdf_variant="pdf/a-3b"))
    write_whole(pdf, content)
    return content
