"""Prints the weight of the code: tokens, lines that hold one, and tokens a line, for each folder.

    python tests/weight.py

Tokens are those of Python's tokenizer without comments, docstrings, line ends and indentation.
"""

import ast
import subprocess
import tokenize
from collections import Counter
from pathlib import Path

GROUPS = {"package and programs": ("damian/", "recipes/"), "all tests": ("tests/",)}
LAYOUT = {
    tokenize.ENCODING,
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def docstrings(source):
    """Where statements that are nothing but a text begin, as (line, column)."""
    texts = set()
    for node in ast.walk(ast.parse(source)):
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            texts.add((value.lineno, value.col_offset))
    return texts


def weight(path):
    """Number of tokens of a file, and of the lines that hold one."""
    left_out = docstrings(path.read_text(encoding="utf-8"))
    tokens = 0
    lines = set()
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type not in LAYOUT and token.start not in left_out:
                tokens += 1
                lines.add(token.start[0])
    return tokens, len(lines)


def main():
    listed = subprocess.run(
        ["git", "ls-files", "*.py"],
        check=True,
        capture_output=True,
        text=True,
    )
    for group, folders in GROUPS.items():
        tokens = Counter()
        lines = Counter()
        for name in listed.stdout.split():
            if name.startswith(folders):
                for key in (group, str(Path(name).parent)):
                    found = weight(Path(name))
                    tokens[key] += found[0]
                    lines[key] += found[1]
        for key, count in tokens.most_common():
            print(
                f"{count:8,} tokens {lines[key]:7,} lines {count / max(lines[key], 1):6.2f}  {key}"
            )


if __name__ == "__main__":
    main()
