"""Pages as a browser reads them, and the worst that a name can be."""

import base64
import gzip
import json
from html.parser import HTMLParser

HOSTILE = """<script>alert(1)</script><img src=x onerror='alert(2)'>"</script><!--&amp;%{x}"""


class Reader(HTMLParser):
    """Reads a page as a browser does: its elements, its text, and the data of its figures."""

    def __init__(self, page):
        super().__init__()
        self.elements, self.text, self.figures, self._data = [], "", [], False
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._data = dict(attrs).get("type") == "application/gzip" and "id" not in dict(attrs)

    def handle_endtag(self, tag):
        self._data = False

    def handle_data(self, data):
        if self._data:
            self.figures.append(json.loads(gzip.decompress(base64.b64decode(data))))
        elif self.elements and self.elements[-1][0] not in ("script", "style"):
            self.text += data

    def texts_of_figures(self):
        """Everything that a figure writes: names of traces, titles, annotations."""
        return json.dumps(self.figures)
