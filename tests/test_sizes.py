"""Files, functions and parameter lists stay small; the exceptions are listed here and may only shrink."""

import pytest

from tests.test_kernels import functions, parameters_of, sources

MAX_FILE_LINES, MAX_FUNCTION_LINES, MAX_PARAMETERS = 350, 70, 8

#: Files over ``MAX_FILE_LINES``, and how long they may be.
LONG_FILES: dict[str, int] = {}
#: Functions over ``MAX_FUNCTION_LINES``.
LONG_FUNCTIONS: dict[str, int] = {}
#: Functions of more than ``MAX_PARAMETERS`` parameters.
MANY_PARAMETERS: dict[str, int] = {}


def lines_of_files():
    return {name: text.count("\n") for name, text in sources()}


def lines_of_functions():
    return {f"{name}:{node.name}": node.end_lineno - node.lineno + 1 for name, node in functions()}


def parameters_of_functions():
    return {f"{name}:{node.name}": len(parameters_of(node)) for name, node in functions()}


@pytest.mark.parametrize(
    ("measure", "limit", "exceptions"),
    [
        (lines_of_files, MAX_FILE_LINES, LONG_FILES),
        (lines_of_functions, MAX_FUNCTION_LINES, LONG_FUNCTIONS),
        (parameters_of_functions, MAX_PARAMETERS, MANY_PARAMETERS),
    ],
)
def test_what_is_too_long_is_listed_and_does_not_grow(measure, limit, exceptions):
    too_long = {name: size for name, size in measure().items() if size > exceptions.get(name, limit)}
    assert too_long == {}, "cut it where its subject changes"


@pytest.mark.parametrize(
    ("measure", "limit", "exceptions"),
    [
        (lines_of_files, MAX_FILE_LINES, LONG_FILES),
        (lines_of_functions, MAX_FUNCTION_LINES, LONG_FUNCTIONS),
        (parameters_of_functions, MAX_PARAMETERS, MANY_PARAMETERS),
    ],
)
def test_an_exception_that_is_far_from_needed_is_taken_off(measure, limit, exceptions):
    sizes = measure()
    assert [name for name in exceptions if sizes.get(name, limit) < 0.75 * limit] == []
