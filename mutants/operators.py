"""The faults that are drawn at random: one operator, number or name becomes its neighbour.

Left alone, because no test need notice: texts, types, decorators, ``__str__``, what is raised or warned about, numbers
below 1e-6 (guards against rounding), and ``<`` against ``<=`` where no whole number stands beside it.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

ARITHMETIC: dict[type[ast.operator], tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "*"),
    ast.Pow: ("**", "*"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
}
COMPARISONS: dict[type[ast.cmpop], tuple[str, str, str]] = {
    ast.Lt: ("<", ">=", "<="),
    ast.LtE: ("<=", ">", "<"),
    ast.Gt: (">", "<=", ">="),
    ast.GtE: (">=", "<", ">"),
    ast.Eq: ("==", "!=", "!="),
    ast.NotEq: ("!=", "==", "=="),
}
NAMES = {
    "min": "max", "argmin": "argmax", "minimum": "maximum", "any": "all", "sin": "cos", "floor": "ceil",
    "mean": "median", "degrees": "radians", "std": "var",
}  # fmt: skip
NAMES |= {after: before for before, after in NAMES.items()}
GUARD = 1e-6


@dataclass(frozen=True, order=True)
class Mutant:
    """Replaces the characters ``start`` to ``end`` of a file (path relative to the project) by ``after``."""

    path: str
    start: int
    end: int
    line: int
    before: str
    after: str

    def applied(self, text: str) -> str:
        """The file's text with the fault in it."""
        if text[self.start : self.end] != self.before:
            raise ValueError(f"{self.path}:{self.line} no longer reads {self.before!r}")
        return text[: self.start] + self.after + text[self.end :]

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.before} -> {self.after}"


def mutants_of(root: Path, path: str) -> list[Mutant]:
    """Every such fault that a file has room for, in the order of the text."""
    finder = _Finder(path, (root / path).read_text(encoding="utf-8"))
    finder.visit(ast.parse(finder.text))
    return sorted(set(finder.found))


class _Finder(ast.NodeVisitor):
    def __init__(self, path: str, text: str) -> None:
        self.path, self.text = path, text
        self.rows = text.splitlines(keepends=True)
        self.begins = [0]
        for row in self.rows:
            self.begins.append(self.begins[-1] + len(row))
        self.found: list[Mutant] = []

    def place(self, line: int, byte: int) -> int:
        return self.begins[line - 1] + len(self.rows[line - 1].encode()[:byte].decode())

    def span(self, node: ast.expr) -> tuple[int, int]:
        assert node.end_lineno is not None and node.end_col_offset is not None
        return self.place(node.lineno, node.col_offset), self.place(node.end_lineno, node.end_col_offset)

    def add(self, start: int, end: int, after: str) -> None:
        line = self.text.count("\n", 0, start) + 1
        self.found.append(Mutant(self.path, start, end, line, self.text[start:end], after))

    def between(self, left: ast.expr, right: ast.expr, before: str, after: str) -> None:
        start = self.text.find(before, self.span(left)[1], self.span(right)[0])
        if start >= 0:
            self.add(start, start + len(before), after)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name != "__str__":
            for one in [*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body]:
                self.visit(one)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for one in node.body:
            self.visit(one)

    def skip(self, node: ast.AST) -> None:
        """Nothing of it changes."""

    visit_Raise = visit_JoinedStr = visit_Import = visit_ImportFrom = visit_Assert = skip

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in ("warn", "append_warning", "TypeVar"):
            return
        if name in NAMES:
            end = self.span(node.func)[1]
            self.add(end - len(name), end, NAMES[name])
        for keyword in node.keywords:
            if keyword.arg == "ddof":
                start, end = self.span(keyword.value)
                self.add(start, end, "0" if self.text[start:end] != "0" else "1")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        text = isinstance(node.left, ast.Constant) and isinstance(node.left.value, str)
        if type(node.op) in ARITHMETIC and not text:
            self.between(node.left, node.right, *ARITHMETIC[type(node.op)])
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if type(node.op) in ARITHMETIC and isinstance(node.target, ast.expr):
            before, after = (f"{sign}=" for sign in ARITHMETIC[type(node.op)])
            self.between(node.target, node.value, before, after)
        self.visit(node.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        sides = [node.left, *node.comparators]
        for left, right, sign in zip(sides, sides[1:], node.ops, strict=False):
            if type(sign) in COMPARISONS:
                before, opposite, bound = COMPARISONS[type(sign)]
                self.between(left, right, before, opposite)
                if _whole(left) or _whole(right):
                    self.between(left, right, before, bound)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        before, after = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        for left, right in zip(node.values, node.values[1:], strict=False):
            self.between(left, right, f" {before} ", f" {after} ")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        start = self.span(node)[0]
        if isinstance(node.op, ast.Not | ast.USub | ast.Invert):
            self.add(start, start + len("not " if isinstance(node.op, ast.Not) else "-"), "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        start, end = self.span(node)
        value = node.value
        if isinstance(value, bool):
            self.add(start, end, str(not value))
        elif isinstance(value, int):
            self.add(start, end, str(value + 1))
        elif isinstance(value, float) and (value == 0 or abs(value) >= GUARD):
            self.add(start, end, "1.0" if value == 0 else repr(2 * value))


def _whole(node: ast.expr) -> bool:
    """Whether an expression is a whole number by its looks: a literal, or a length."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int)
    return isinstance(node, ast.Call) and getattr(node.func, "id", "") == "len"
