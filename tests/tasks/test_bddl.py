"""Reading and writing of BDDL problems."""

from __future__ import annotations

import re

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.bddl import Region, parse_bddl
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import And, Atom, Not
from tests.support.scripts import load_script

format_bddl = load_script("strict_suite/bddl_text").format_bddl


def test_reads_everything(bddl: str) -> None:
    problem = parse_bddl(bddl)
    assert (problem.name, problem.domain) == ("KITCHEN", "robosuite")
    assert problem.language == "put the cup, the red one, into the drawer"
    assert problem.objects == {"cup_1": "cup", "cup_2": "cup", "lid,v1.2": "lid"}
    assert list(problem.fixtures) == ["table_1", "box_1"]
    place = Region("cup_place", "table_1", ((0.0, 0.0, 0.1, 0.1), (0.2, 0.2, 0.3, 0.3)), (0.0, 1.5))
    assert problem.regions["table_1_cup_place"] == place
    assert problem.regions["box_1_top_region"] == Region("top_region", "box_1")
    assert problem.objects_of_interest == ("cup_1", "box_1")
    assert problem.init[3:] == (Atom("on", ("lid,v1.2", "cup_2")), Atom("close", ("box_1_top_region",)))
    drawer = "box_1_top_region"
    assert problem.goal == And((Atom("in", ("cup_1", drawer)), Not(Atom("open", (drawer,)))))


def test_keywords_predicates_and_references_in_any_case(bddl: str) -> None:
    shouted = bddl
    for word in (
        "define",
        "problem",
        ":domain",
        ":regions",
        ":target",
        ":ranges",
        ":goal",
        "And",
        "In",
        "Not",
        "On",
    ):
        shouted = re.sub(rf"\({word}\b", f"({word.upper()}", shouted)
    shouted = shouted.replace("(IN cup_1", "(IN CUP_1")
    assert parse_bddl(shouted) == parse_bddl(bddl)


def test_language_is_free_text(bddl: str) -> None:
    text = "put  the\n  Cup (red) - not: the other one, please"
    problem = parse_bddl(bddl.replace("put the cup, the red one, into the drawer", text))
    assert problem.language == "put the Cup (red) - not: the other one, please"


def test_optional_sections(bddl: str) -> None:
    problem = parse_bddl(bddl.replace("(:domain robosuite)", "").replace("(:obj_of_interest cup_1 box_1)", ""))
    assert problem.domain == ""
    assert problem.objects_of_interest == ()


def test_a_region_on_what_is_not_declared_is_let_pass_until_it_is_used(bddl: str) -> None:
    """LIBERO's ten goal tasks have one: a region of a drainer that is not there, which no atom names."""
    libero = bddl.replace("(top_region", "(right_region (:target Drainer_1))\n    (top_region")
    problem, without = parse_bddl(libero), parse_bddl(bddl)
    assert problem.regions == without.regions
    assert (problem.init, problem.goal) == (without.init, without.goal)
    assert parse_bddl(format_bddl(problem)).regions == without.regions
    used = libero.replace("(Not (Open box_1_top_region))", "(On cup_1 drainer_1_right_region)")
    with pytest.raises(
        MemobenchError, match=r"^a\.bddl, line 7: found the target 'Drainer_1' of region 'right_region'"
    ):
        parse_bddl(used, "a.bddl")
    checkpoint = Atom("on", ("cup_1", "drainer_1_right_region"))  # as checkpoints name it
    with pytest.raises(MemobenchError, match="'right_region', which is not declared"):
        problem.resolve(checkpoint, "a.json")
    with pytest.raises(MemobenchError, match="'drainer_1_right_region' in :obj_of_interest"):
        parse_bddl(libero.replace("(:obj_of_interest cup_1", "(:obj_of_interest drainer_1_right_region"))


MALFORMED = [
    # (what is replaced, by what, line of the error, words in it)
    ("(define", "(definition", 1, "expected (define (problem NAME)"),
    ("(problem KITCHEN)", "(problem)", 1, "(problem NAME)"),
    ("(problem KITCHEN)", "problem KITCHEN", 1, "(problem NAME)"),
    ("(:domain robosuite)", "(:domain)", 2, "0 words in :domain"),
    ("(:domain robosuite)", "(:domian robosuite)", 2, "unknown section ':domian'"),
    ("(:domain robosuite)", "(:domain robosuite) (:domain robosuite)", 2, "a second :domain"),
    ("(:domain robosuite)", "robosuite", 2, "found 'robosuite'"),
    ("(:domain robosuite)", "()", 2, "an empty list ()"),
    ("put the cup, the red one, into the drawer", "", 3, "an empty :language"),
    ("(cup_place (:target table_1)", "(cup_place", 5, "without (:target"),
    ("(cup_place (:target table_1)", "(cup_place (:target tabel_1)", 5, "did you mean 'table_1'"),
    ("(cup_place (:target table_1)", "(cup_place (:target table_1 box_1)", 5, "2 values in :target"),
    ("(cup_place (:target table_1)", "(cup_place (:target table_1) (:target table_1)", 5, "a second :target"),
    ("(:yaw_rotation ((0.0 1.5)))", "(:yaw ((0.0 1.5)))", 5, "unknown clause ':yaw'"),
    ("(:yaw_rotation ((0.0 1.5)))", "(:yaw_rotation ((1.5 0.0)))", 5, "low <= high"),
    ("(:yaw_rotation ((0.0 1.5)))", "(:yaw_rotation ((0.0 1.5) (0.0 1.0)))", 5, "2 yaw intervals"),
    ("(:yaw_rotation ((0.0 1.5)))", "(:yaw_rotation (0.0))", 5, "low high in radians"),
    ("((-0.1 -0.1 0.0 0.0))", "((-0.1 -0.1 0.0))", 6, "found 3 value(s)"),
    ("((-0.1 -0.1 0.0 0.0))", "((-0.1 -0.1 -0.2 0.0))", 6, "x1 <= x2"),
    ("((-0.1 -0.1 0.0 0.0))", "((-0.1 -0.1 zero 0.0))", 6, "found 'zero'"),
    ("((-0.1 -0.1 0.0 0.0))", "((-0.1 -0.1 nan 0.0))", 6, "a finite number"),
    ("((-0.1 -0.1 0.0 0.0))", "((-0.1 -0.1 1e999 0.0))", 6, "a finite number"),
    ("((-0.1 -0.1 0.0 0.0))", "()", 6, "empty :ranges"),
    (" (:ranges ((-0.1 -0.1 0.0 0.0)))", "", 19, "without :ranges"),
    ("(box_place", "(cup_place", 6, "declared again"),
    ("(box_place (:target table_1)", "()  (box_place (:target table_1)", 6, "an empty list ()"),
    ("table_1 - kitchen_table", "table_1 - kitchen_table table_1 - shelf", 10, "'table_1' declared again"),
    ("table_1 - kitchen_table", "table_1 - kitchen_table Table_1 - shelf", 10, "'Table_1' declared again"),
    ("lid,v1.2 - lid", "lid,v1.2 -", 15, "'-' without a class"),
    ("cup_1 cup_2 - cup", "cup_1 cup_2 -", 15, "'-' without a name"),
    ("cup_1 cup_2 - cup", "- cup", 14, "'-' without a name"),
    ("lid,v1.2 - lid", "lid,v1.2", 15, "'lid,v1.2' without a class"),
    ("lid,v1.2 - lid", "lid,v1.2 (- lid)", 15, "found a list (- ...)"),
    ("(:obj_of_interest cup_1", "(:obj_of_interest cup_3", 17, "'cup_3' in :obj_of_interest"),
    ("    (On cup_1 table_1_cup_place)\n", "", 18, "no place for the object 'cup_1'"),
    (
        "(On cup_1 table_1_cup_place)",
        "(On cup_1 table_1_cup_place) (On cup_1 cup_2)",
        20,
        "a second place for 'cup_1'",
    ),
    ("(On cup_2 table_1_cup_place)", "(On cup_2 lid,v1.2)", 18, "resting on itself"),
    ("(On cup_2 table_1_cup_place)", "(Not (On cup_2 table_1_cup_place))", 21, "'not' in :init"),
    ("(Close box_1_top_region)", "(WasOpen box_1_top_region)", 23, "'wasopen' in :init"),
    ("(Close box_1_top_region)", "Close", 23, "found 'Close'"),
    ("(Close box_1_top_region)", "(Close cup_1)", 23, "the object 'cup_1'"),
    ("(On cup_1 table_1_cup_place)", "(On table_1_cup_place cup_1)", 20, "the region 'table_1_cup_place'"),
    ("(In cup_1 box_1_top_region)", "(In cup_1 box_1)", 25, "expected region"),
    ("(In cup_1 box_1_top_region)", "(In cup_1 top_region)", 25, "which none of"),
    ("(In cup_1 box_1_top_region)", "(In cup_1)", 25, "1 argument(s)"),
    ("(In cup_1 box_1_top_region)", "(Into cup_1 box_1_top_region)", 25, "'Into'"),
    ("(In cup_1 box_1_top_region)", "(In cup_1 (top box_1))", 25, "an entity name"),
    ("(In cup_1 box_1_top_region)", "(In cup_1 box_1_top_region", 1, "never closed"),
    ("(Not (Open box_1_top_region))", "(Not)", 25, "nothing in it"),
    ("(:goal (And", "(:goal (On cup_1 box_1) (And", 25, "2 formulas in :goal"),
]


@pytest.mark.parametrize(("old", "new", "line", "words"), MALFORMED)
def test_malformed_file_names_file_line_found_expected(bddl: str, old: str, new: str, line: int, words: str) -> None:
    assert bddl.count(old) >= 1
    with pytest.raises(MemobenchError) as error:
        parse_bddl(bddl.replace(old, new, 1), "some/file.bddl")
    message = str(error.value)
    assert message.startswith(f"some/file.bddl, line {line}: found ")
    assert words in message
    assert "expected" in message or "did you mean" in message or "known" in message
    assert "\n" not in message


@pytest.mark.parametrize("section", [":language", ":fixtures", ":init", ":goal"])
def test_missing_section(bddl: str, section: str) -> None:
    broken = re.sub(rf"  \({section}\b.*?\n(?=  \(:|\)$)", "", bddl, flags=re.DOTALL | re.MULTILINE)
    with pytest.raises(MemobenchError, match=f"found no {section} section, expected all of"):
        parse_bddl(broken)


@pytest.mark.parametrize(
    "text", ["", "  ; nothing\n", "word", ")", "(", "()", "(define)", "(a) (b)", "(define (problem p)) x"]
)
def test_no_problem_at_all(text: str) -> None:
    with pytest.raises(MemobenchError, match=r"found .* expected"):
        parse_bddl(text)


def test_deep_nesting_is_an_error_not_a_crash(bddl: str) -> None:
    deep = "(Not " * 50_000 + "(Open box_1)" + ")" * 50_000
    with pytest.raises(MemobenchError, match="nested deeper"):
        parse_bddl(bddl.replace("(Not (Open box_1_top_region))", deep))
    with pytest.raises(MemobenchError, match="line 1"):
        parse_bddl("(" * 50_000)


# --- writing ---


def test_print_and_parse_give_the_same_problem(bddl: str) -> None:
    problem = parse_bddl(bddl)
    assert parse_bddl(format_bddl(problem, "a comment (with parentheses)")) == problem
    for name in task_names():
        task = get_task(name)
        problem = parse_bddl(task.bddl_text, name)
        assert parse_bddl(format_bddl(problem)) == problem
