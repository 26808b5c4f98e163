"""The door: exit codes, one line on stderr, and nothing heavy loaded before it is needed."""

import subprocess
import sys

import pytest

from grindvision import cli
from grindvision.errors import GrindvisionWarning, InputError


def command(monkeypatch, run):
    """Put a command of our own behind the name ``simulate``."""
    import types

    module = types.ModuleType("grindvision.cli.simulate")
    vars(module).update(
        add_arguments=lambda parser: parser.add_argument("--seed", type=int, required=True),
        run=run,
    )
    monkeypatch.setitem(sys.modules, "grindvision.cli.simulate", module)


def test_a_finished_command_exits_with_0_and_gets_its_options(monkeypatch):
    seen = []

    def keep(options) -> int:
        seen.append(options.seed)
        return 0

    command(monkeypatch, keep)
    assert cli.main(["simulate", "--seed", "7"]) == 0
    assert seen == [7]


def test_bad_input_is_one_line_and_exit_2(monkeypatch, capsys):
    def run(_):
        raise InputError("the cloud\nis empty; scan again")

    command(monkeypatch, run)
    assert cli.main(["simulate", "--seed", "7"]) == 2
    assert capsys.readouterr().err == "grindvision simulate: the cloud is empty; scan again\n"


def test_a_defect_is_one_line_and_exit_1(monkeypatch, capsys):
    command(monkeypatch, lambda _: 1 / 0)
    monkeypatch.delenv("GRINDVISION_DEBUG", raising=False)
    assert cli.main(["simulate", "--seed", "7"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "ZeroDivisionError" in error and "GRINDVISION_DEBUG" in error


def test_a_warning_is_one_line_and_the_result_stands(monkeypatch, capsys):
    import warnings

    def run(_):
        warnings.warn("two points\ndropped", GrindvisionWarning, stacklevel=1)
        return 0

    command(monkeypatch, run)
    assert cli.main(["simulate", "--seed", "7"]) == 0
    assert capsys.readouterr().err == "warning: two points dropped\n"


@pytest.mark.parametrize("words", [["simulate"], ["simulate", "--seed", "x"], ["paint"], []])
def test_wrong_words_are_one_line_and_exit_2(monkeypatch, capsys, words):
    command(monkeypatch, lambda _: 0)
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_help_loads_nothing_heavy():
    heavy = ("numpy", "scipy", "pandas", "open3d", "pinocchio", "pyvista", "matplotlib", "numba")
    code = (
        "import sys, contextlib, io\nfrom grindvision.cli import main\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):\n    main(['--help'])\n"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_a_process_of_one_command_imports_what_is_seldom_asked_for_when_it_is_asked_for():
    code = (
        "import sys\nfrom grindvision.cli import own_process, pictures\n"
        "own_process.take_over()\nimport numpy\nown_process.postpone()\n"
        "pictures.drawing('detect_picture')\nimport numba, scipy.linalg, fontTools.agl as names\n"
        "print(*('__loader__' in vars(sys.modules[name]) and bool(vars(sys.modules[name])['__loader__'])"
        " for name in own_process.SELDOM_ASKED), names.toUnicode('alpha'))\n"
        "import fontTools.agl, numpy.f2py.symbolic\nprint('toUnicode' in vars(sys.modules['fontTools.agl']),"
        " callable(numpy.testing.assert_equal), callable(numpy.f2py.symbolic.Expr))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["False"] * 4 + ["α"] + ["True"] * 3
