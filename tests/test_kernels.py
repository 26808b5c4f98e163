"""Compiled kernels: few parameters, a docstring each, kept in the package's own cache."""

import ast
from functools import cache
from pathlib import Path

import grindvision

PACKAGE = Path(grindvision.__file__).parent
HOUSES = {"grindvision": PACKAGE, "grindvision_book": PACKAGE.parent / "grindvision_book"}

MAX_KERNEL_PARAMETERS = 8


def sources():
    for house, folder in HOUSES.items():
        for path in sorted(folder.rglob("*.py")):
            yield f"{house}/{path.relative_to(folder).as_posix()}", path.read_text(encoding="utf-8")


@cache
def functions():
    trees = [(name, ast.parse(text)) for name, text in sources()]
    return [(name, node) for name, tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def parameters_of(node):
    taken = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return [one.arg for one in taken if one.arg not in ("self", "cls")]


def kernels():
    for name, node in functions():
        if any("njit" in ast.unparse(decorator) for decorator in node.decorator_list):
            yield f"{name}:{node.name}", node


def test_kernels_are_found():
    assert len(list(kernels())) > 60


def test_every_kernel_has_few_parameters():
    assert {
        name: len(parameters_of(node)) for name, node in kernels() if len(parameters_of(node)) > MAX_KERNEL_PARAMETERS
    } == {}


def test_every_kernel_says_what_it_does():
    assert [name for name, node in kernels() if not ast.get_docstring(node)] == []


def test_kernels_are_kept_in_the_package_s_own_cache():
    # numba's own cache goes on with old machine code when a kernel in another file changes, and needs a folder to write
    plain = [name for name, text in sources() if "from numba import njit" in text or "@numba.njit" in text]
    assert plain == []
