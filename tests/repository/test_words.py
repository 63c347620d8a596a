"""Spelling is American, and unidiomatic words only become fewer."""

import re
from collections import Counter

from tests.support.sources import ROOT

DIALECT = re.compile(
    r"\b(told|beside|anew|in the place of|goes on|go on|of its own|of their own|fewest|mend(?:s|ed)?|learnt by heart"
    r"|so many|those that|lies)\b",
    re.IGNORECASE,
)
MAX_DIALECT_WORDS = 45  # some uses are right: "the point lies on the ray", "beside" as a position
BRITISH = re.compile(
    r"colour|\bgrey|centre|licence|neighbour|behaviour|favour|learnt|\bmetres?\b|(?:normal|quant|optim|minim|recogn)is(?:e|i|ation)",
    re.IGNORECASE,
)
WRITTEN = ROOT / "docs" / "brighton.html"  # by `clsplat view`
FOLDERS = "clsplat", "cl_kernels", "data_tools", "pipelines", "docs", "examples"
SUFFIXES = {".py", ".cl", ".h", ".js", ".css", ".yaml", ".md", ".html", ".toml"}


def matches(pattern):
    """(file:line, word) of every match in the product and its docs."""
    files = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*")) if path.suffix in SUFFIXES]
    for path in [*sorted(ROOT.glob("*.md")), *(file for file in files if file != WRITTEN)]:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            for match in pattern.finditer(line):
                yield f"{path.relative_to(ROOT)}:{number}", match[0].lower()


def test_spelling_is_american():
    assert not (uses := list(matches(BRITISH))), "\n".join(f"{where}: {word}" for where, word in uses)


def test_dialect_words_become_fewer():
    uses = list(matches(DIALECT))
    counts = Counter(word for _, word in uses)
    assert len(uses) <= MAX_DIALECT_WORDS, f"{len(uses)} uses: {counts.most_common()}; write as the field writes"
