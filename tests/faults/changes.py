"""Single changes of a module's text, generated: one token of one line, or what must count for nothing.

`of_each_line` changes every line that holds anything that can be changed: a name gets a longer one, a number another digit,
a text another letter, an operator its neighbour.  `of_no_account` changes comments, docstrings and layout, all there are.
"""

from __future__ import annotations

import ast
import io
import keyword
import tokenize
from collections.abc import Iterator

OTHER = {
    "True": "False", "False": "True", "None": "0", "and": "or", "or": "and", "not": "", "is": "==", "in": "not in", "pass": "...", "continue": "break",
    "break": "continue", "return": "return 0,", "yield": "yield 0,", "raise": "raise ValueError", "...": "1", "lambda": "lambda x_, ", "nonlocal": "global",
    "+": "-", "-": "+", "*": "+", "/": "*", "//": "/", "**": "*", "@": "*", "%": "*", "<": "<=", ">": ">=", "<=": "<", ">=": ">", "==": "!=", "!=": "==",
    "|": "&", "&": "|", "^": "|", "<<": ">>", ">>": "<<", "~": "-", "+=": "-=", "-=": "+=", "*=": "+=", "/=": "*=", "|=": "&=", "&=": "|=", "@=": "*=",
}  # fmt: skip
Token = tokenize.TokenInfo


def tokens_of(text: str) -> list[Token]:
    """As Python reads them."""
    return list(tokenize.generate_tokens(io.StringIO(text).readline))


def lines_of(text: str) -> list[int]:
    """Lines that hold code: not a comment, not a part of a docstring, not layout alone."""
    return sorted({token.start[0] for token in _code_of(text)})


def of_each_line(text: str) -> Iterator[tuple[int, list[str]]]:
    """Each line of code, and the texts in which one token of it is another, the likeliest first; some of them may be no Python."""
    lines, by_line = text.splitlines(keepends=True), {}
    for token in _code_of(text):
        by_line.setdefault(token.start[0], []).append(token)
    for number, tokens in sorted(by_line.items()):
        yield number, [_with(lines, token, new) for token in tokens if (new := _other(token)) is not None]


def of_no_account(text: str) -> dict[str, str]:
    """By what was done: texts that say the same to Python."""
    tokens, words = tokens_of(text), _docstrings(text)
    lines = text.splitlines(keepends=True)
    ends = {
        token.start[0]: token.start[1]
        for token in tokens
        if token.type in (tokenize.NEWLINE, tokenize.NL) and _stands_alone(token, tokens)
    }
    remarked = "".join(
        f"{line[: ends[k]]}  # a remark{line[ends[k] :]}" if k in ends else line for k, line in enumerate(lines, 1)
    )
    rewritten = list(lines)
    for token in reversed([token for token in tokens if token.start in words]):
        rewritten = _with(
            rewritten, token, f'{token.string[0] if token.string[0] in "rR" else ""}"""Other words."""'
        ).splitlines(keepends=True)
    bare = "".join(
        line
        for k, line in enumerate(lines, 1)
        if not any(t.type == tokenize.COMMENT and t.start[0] == k and not t.line[: t.start[1]].strip() for t in tokens)
    )
    statements = sorted({token.end[0] for token in tokens if token.type == tokenize.NEWLINE})
    spread = "".join(line + ("\n" if k in statements else "") for k, line in enumerate(lines, 1))
    return {
        "remarks": remarked,
        "docstrings": "".join(rewritten),
        "no comments": bare,
        "empty lines": spread,
        "formatted anew": ast.unparse(ast.parse(text)),
    }


def _stands_alone(token: Token, tokens: list[Token]) -> bool:
    """Whether a remark may stand before this end of a line: it has none, and no backslash joins it to the next."""
    return "#" not in token.line and not token.line.rstrip("\n").endswith("\\")


def _code_of(text: str) -> Iterator[Token]:
    words = _docstrings(text)
    for token in tokens_of(text):
        if token.type in (tokenize.NAME, tokenize.NUMBER, tokenize.OP) or (
            token.type == tokenize.STRING and token.start not in words
        ):
            yield token


def _docstrings(text: str) -> set[tuple[int, int]]:
    """Where the texts begin that count for nothing: first in a module, class or function, and alone in the body of a class."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and body:
            texts = [item for item in (body if isinstance(node, ast.ClassDef) else body[:1]) if _is_text(item)]
            found |= {(item.lineno, item.col_offset) for item in texts}
    return found


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _other(token: Token) -> str | None:
    if token.string in OTHER:
        return OTHER[token.string]
    if token.type == tokenize.NUMBER:
        return f"{token.string}7"
    if token.type == tokenize.NAME:
        return None if keyword.iskeyword(token.string) else f"{token.string}_"
    if token.type == tokenize.STRING:
        quotes = 3 if token.string.endswith(('"""', "'''")) and len(token.string) > 5 else 1
        return f"{token.string[:-quotes]}x{token.string[-quotes:]}"
    return None


def _with(lines: list[str], token: Token, new: str) -> str:
    """The text with `new` in the token's place; columns are characters."""
    (first, begin), (last, end) = token.start, token.end
    return "".join([*lines[: first - 1], lines[first - 1][:begin] + new + lines[last - 1][end:], *lines[last:]])
