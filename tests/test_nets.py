"""The nets of a redesign: their comparison notices a difference, and each mutant still has its text in the source."""

import pytest

from scripts.nets.mutants import place_of, table
from scripts.nets.store import ROOT, differences, flatten


def test_a_comparison_names_fields_that_went_came_and_changed():
    old = {"a": {"x": 1.0, "hash bits": "aa", "went": None}, "b": {"x": 1.0}}
    new = {"a": {"x": 1.0 + 1e-9, "hash bits": "ab", "came": True}, "b": {"x": 2.0}}
    assert differences(old, old, True) == []
    heads = [line for line in differences(old, new, False) if not line.startswith(" ")]
    assert heads == ["came: came, 1 times", "went: went, 1 times", "x: changed, 1 times"]
    heads = [line for line in differences(old, new, True) if not line.startswith(" ")]
    assert heads == ["came: came, 1 times", "hash bits: changed, 1 times", "went: went, 1 times", "x: changed, 2 times"]


def test_nested_values_are_flattened():
    assert flatten({"a": [1, {"b": None}], "c": {}, "d": "e"}) == {"a.0": 1, "a.1.b": None, "c": "{}", "d": "e"}


@pytest.mark.parametrize("name", table())
def test_a_mutant_has_its_text_in_the_source(name):
    _, _, old, new = table()[name]
    assert place_of(old, ROOT).read_text().replace(old, new).count(old) == 0
