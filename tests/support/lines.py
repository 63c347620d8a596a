"""Count the code lines of a wheel: `python -m tests.support.lines`.

Blank lines, comments and docstrings do not count, nor do the recipes.
"""

import ast
import io
import re
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
PARTS = ("clsplat", "data_tools", "cl_kernels")
KINDS = {
    ".py": "Python", ".cl": "kernels", ".h": "kernels", ".js": "JavaScript", ".css": "CSS", ".j2": "templates",
}  # fmt: skip
BLANK = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def python_lines(text: str) -> int:
    """Count the lines that hold more than comments and docstrings."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = {line for token in tokens if token.type not in BLANK for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def other_lines(text: str) -> int:
    """Count the lines that are not empty without comments."""
    text = re.sub(r"/\*.*?\*/|<!--.*?-->|\{#.*?#\}", blank, text, flags=re.DOTALL)
    text = re.sub(r"^\s*//.*$", "", text, flags=re.MULTILINE)
    return sum(bool(line.strip()) for line in text.splitlines())


def blank(match: re.Match[str]) -> str:
    return "\n" * match.group().count("\n")


def main() -> None:
    lines: Counter[str] = Counter()
    files: Counter[str] = Counter()
    for part in PARTS:
        for file in sorted((ROOT / part).rglob("*")):
            if kind := KINDS.get(file.suffix):
                text = file.read_text(encoding="utf-8")
                lines[kind] += python_lines(text) if kind == "Python" else other_lines(text)
                files[kind] += 1
    for kind, count in lines.most_common():
        print(f"{kind:<11}{files[kind]:>5} files{count:>8,} lines")
    print(f"{'all':<11}{files.total():>5} files{lines.total():>8,} lines")


if __name__ == "__main__":
    main()
