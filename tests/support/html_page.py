"""A page as a browser's parser takes it: its elements, its text, its scripts."""

import re
from collections import Counter
from html.parser import HTMLParser

HOSTILE = "<script>\"'&amp;<b>"  # also a valid name of a file
VOID = {"meta", "link", "img", "br", "input"}  # elements without an end
ADDRESSES = {"src", "href", "action", "srcset", "data", "poster"}


class Page(HTMLParser):
    """Read a page; fail where an element is not closed, has a handler, or refers to something outside of the page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: Counter[str] = Counter()
        self.attributes: list[str] = []  # values
        self.words: list[str] = []  # text, outside of scripts and styles
        self.code: list[str] = []  # scripts and styles
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    @property
    def text(self) -> str:
        return "".join(self.words)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements[tag] += 1
        for name, value in attributes:
            assert not name.startswith("on"), f"a handler: <{tag} {name}={value}>"
            beside = tag == "a" and re.fullmatch(r"[\w-][\w.%/-]*", value or "")  # a page that the run has written too
            assert name not in ADDRESSES or beside or (value or "").startswith("data:"), f"not in the page: {value}"
            self.attributes.append(value or "")
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements[tag] += 1  # of an SVG

    def handle_endtag(self, tag: str) -> None:
        assert self._open, f"</{tag}> closes nothing"
        assert self._open.pop() == tag, f"</{tag}> closes another element"

    def handle_data(self, data: str) -> None:
        inside = self._open and self._open[-1] in ("script", "style")
        (self.code if inside else self.words).append(data)
