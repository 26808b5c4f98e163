"""Parameters from a TOML file, and the file written beside the results: keys are the long options' names."""

from __future__ import annotations

import argparse
import difflib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from grindvision import __version__
from grindvision.errors import InputError
from grindvision.files import read_toml
from grindvision.words import counted

#: Options that say where results go, not what they are.
NO_PARAMETERS = ("help", "output", "parameters", "json")


def number(text: str) -> float:
    """A finite number, as the type of an option."""
    value = float(text)
    if value - value != 0:
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def whole(text: str) -> int:
    """A whole number, as the type of an option."""
    if not re.fullmatch(r"[+-]?\d{1,18}", text):
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is not a whole number")
    return int(text)


def check_count(option: str, value: int, minimum: int, maximum: int) -> None:
    """Refuse a number of things that cannot be meant.

    Raises:
        InputError: it lies outside ``minimum`` to ``maximum``.
    """
    if not minimum <= value <= maximum:
        raise InputError(f"{option} is {value}; give at least {minimum} and at most {maximum}")


def with_parameter_file(command: argparse.ArgumentParser, words: Sequence[str]) -> list[str]:
    """The words of a command line, the parameters of its ``--parameters`` file put before them, so that words win.

    Raises:
        FileError: the file is missing or no TOML. InputError: a key or a value that the command does not take.
    """
    plain = [_without_exponent(word) for word in words]
    named = [
        plain[at + 1] if word == "--parameters" else word.partition("=")[2]
        for at, word in enumerate(plain)
        if word.startswith("--parameters=") or (word == "--parameters" and at + 1 < len(plain))
    ]
    if not named:
        return plain
    options = {name[2:]: action for action in command._actions for name in action.option_strings if name[:2] == "--"}
    options = {name: action for name, action in options.items() if name not in NO_PARAMETERS}
    path = Path(named[-1])
    before: list[str] = []
    for key, value in read_toml(path).items():
        name = key.replace("_", "-")
        if name not in options:
            near = difflib.get_close_matches(name, options, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]}?" if near else f"it takes {', '.join(options)}"
            raise InputError(f"{path}: {key!r} is no parameter of this command; {hint}")
        before += _words(path, name, value, options[name])
    return before + plain


def parameters_text(command: str, parameters: Mapping[str, Any], from_the_data: Mapping[str, Any]) -> str:
    """The TOML text of all parameters of a run; what followed from the data stands there as a comment."""
    lines = [f"# grindvision {__version__} {command}; `--parameters` with this file runs it again in the same way"]
    for name, value in parameters.items():
        if value is None:
            lines.append(f"# {name} was not given")
        elif isinstance(value, str) and _not_utf8(value):
            lines.append(f"# {name} = {value!a}: this name is no UTF-8; give it on the command line")
        else:
            lines.append(f"{name} = {_toml(value)}")
    if from_the_data:
        lines += ["", "# from the data:"]
        lines += [f"# {name} = {_toml(value)}" for name, value in from_the_data.items()]
    return "\n".join(lines) + "\n"


def _words(path: Path, name: str, value: Any, action: argparse.Action) -> list[str]:
    """One parameter as words of a command line."""
    option = f"--{name}"
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise InputError(f"{path}: {name} is {_shown(value)}; write true or false")
        return [option] if value else []
    values = value if isinstance(value, list) else [value]
    if action.nargs in (None, "+"):
        fits = len(values) == 1 if action.nargs is None else len(values) > 0
    else:
        fits = len(values) == action.nargs
    if not fits:
        raise InputError(f"{path}: {name} is {_shown(value)}; give {counted(int(action.nargs or 1), 'value')}")
    kind: tuple[type, ...] = (str,)
    wanted = "a text in quotes"
    if action.type is number:
        kind, wanted = (int, float), "a number"
    elif action.type is whole:
        kind, wanted = (int,), "a whole number"
    convert = action.type if callable(action.type) else str
    for one in values:
        if not isinstance(one, kind) or isinstance(one, bool):
            raise InputError(f"{path}: {name} is {_shown(value)}; write {wanted}")
        if action.choices is not None and one not in action.choices:
            raise InputError(f"{path}: {name} is {_shown(value)}; choose from {', '.join(map(str, action.choices))}")
        try:
            convert(str(one))
        except (argparse.ArgumentTypeError, ValueError):
            raise InputError(f"{path}: {name} is {_shown(value)}; write {wanted}") from None
    texts = [_without_exponent(str(one)) for one in values]
    return [option, *texts] if action.nargs is not None else [f"{option}={texts[0]}"]


def _without_exponent(word: str) -> str:
    """A negative number without an exponent, which the parser would take for an option."""
    if re.fullmatch(r"-(\d+\.?\d*|\.\d+)[eE][+-]?\d{1,3}", word):
        return f"{float(word):.340f}".rstrip("0") + "0"
    return word


def _shown(value: Any) -> str:
    try:
        return repr(value)[:60]
    except ValueError:  # Python refuses to write out whole numbers of more than 4300 digits
        return "a number of thousands of digits"


def _not_utf8(text: str) -> bool:
    """Whether a file's name holds bytes that are no UTF-8, which TOML cannot hold."""
    return any("\udc80" <= character <= "\udcff" for character in text)


def _toml(value: Any) -> str:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_toml(item) for item in value)}]"
    if isinstance(value, (bool, str, Path)):
        return json.dumps(str(value) if isinstance(value, Path) else value, ensure_ascii=False)
    return repr(value)
