"""LeRobot's flags in both spellings."""

from __future__ import annotations

from lerobot_memobench.run.arguments import flag_value, has_flag, joined_flags, whole_number, without_flag


def test_flags_are_found_in_both_spellings() -> None:
    flags = ["--a.b=1", "--c", "2", "--d", "--a.b=3"]
    assert flag_value(flags, "a.b") == "3"
    assert flag_value(flags, "c") == "2"
    assert flag_value(flags, "d") is None
    assert has_flag(flags, "d")
    assert not has_flag(flags, "a")


def test_flags_in_both_spellings() -> None:
    assert joined_flags(["--a", "1", "--b=2", "--c", "--d", "x"]) == ["--a=1", "--b=2", "--c", "--d=x"]
    assert without_flag(["--a", "1", "--b=2", "--a=3", "--ab=4"], "a") == ["--b=2", "--ab=4"]


def test_numbers() -> None:
    assert [whole_number(text) for text in ("7", "-1", "null", None)] == [7, -1, None, None]
