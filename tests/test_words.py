"""Numbers in messages: one thing is singular, none and several are plural."""

import re

import pytest

from grindvision.words import counted
from tests.test_kernels import sources


@pytest.mark.parametrize(
    ("number", "words", "said"),
    [
        (0, ("bead",), "0 beads"),
        (1, ("bead",), "1 bead"),
        (2, ("bead",), "2 beads"),
        (1, ("pass", "passes"), "1 pass"),
        (11, ("pass", "passes"), "11 passes"),
        (1, ("place stands", "places stand"), "1 place stands"),
    ],
)
def test_a_number_and_its_noun_agree(number, words, said):
    assert counted(number, *words) == said


def test_no_message_leaves_the_plural_to_its_reader():
    undecided = [f"{name}: {found}" for name, text in sources() for found in re.findall(r"\} \w+\((?:s|es)\)", text)]
    assert undecided == []
