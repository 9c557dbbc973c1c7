"""The paper's own figures against one another."""

from __future__ import annotations

from dataclasses import replace

from research.agreement.published import annotator_agreement, disagreements, from_published, odd_ones_out
from research.agreement.study import Labels, study


def test_what_the_paper_publishes_is_consistent() -> None:
    found = from_published(annotator_agreement())
    assert len(found) == 7
    assert [each.name for each in found if not each.agrees] == []


def test_a_changed_matrix_would_be_noticed() -> None:
    paper = annotator_agreement()
    changed = replace(paper, confusion={**paper.confusion, "C": (0, 30, 21)})
    wrong = {each.name for each in from_published(changed) if not each.agrees}
    assert {"pooled agreement with released labels", "Fleiss' κ"} <= wrong


def test_labels_that_fit_everything_published_have_its_kappas() -> None:
    """The only labels (but for names) that fit the text's 8 U/C and 6 S/U splits, the columns of the matrix and κ.

    The third rater is the majority everywhere: 36 S, 41 U, 7 C. The first says U for 6 of the S and C for 2 of the U,
    the second U for 6 of the C.
    """
    paper = annotator_agreement()
    third = "S" * 36 + "U" * 41 + "C" * 7
    first = "U" * 6 + "S" * 30 + "C" * 2 + "U" * 39 + "C" * 7
    second = "S" * 36 + "U" * 41 + "U" * 6 + "C"
    found = study(Labels(tuple(map(str, range(84))), {"1": tuple(first), "2": tuple(second), "3": tuple(third)}))
    assert found.fleiss is not None
    assert round(found.fleiss, 3) == paper.fleiss_kappa
    assert tuple(round(value, 3) for value in found.cohen.values() if value is not None) == paper.cohen_kappa
    assert found.exact == paper.exact
    assert found.splits == {"S/U": 6, "U/C": 8}
    given = first + second + third
    assert [given.count(label) for label in "SUC"] == [
        sum(column) for column in zip(*paper.confusion.values(), strict=True)
    ]


def test_who_is_alone_follows_from_cohens_kappas() -> None:
    apart = disagreements(annotator_agreement().cohen_kappa, 84, 0.4469)
    assert apart == [14, 8, 6]
    assert odd_ones_out(apart) == [8, 6, 0]
