"""Topics by name and by expression, as people know it from rosbag2."""

import pytest

from replay.topic_choice import TopicChoice

TOPICS = ("/tf", "/tf_static", "/gmsl/A0/image", "/gmsl/A0/camera_info", "bare")


def chosen(*names, regex=None, exclude=None):
    choice = TopicChoice.of(names, regex, exclude)
    return [topic for topic in TOPICS if choice.wants(topic)]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, list(TOPICS)),
        ({"regex": "^/tf"}, ["/tf", "/tf_static"]),
        ({"regex": "A0", "exclude": "image$"}, ["/gmsl/A0/camera_info"]),
        ({"exclude": "gmsl"}, ["/tf", "/tf_static", "bare"]),
    ],
)
def test_expressions_match_anywhere_in_a_name(options, expected):
    assert chosen(**options) == expected


def test_names_are_whole_and_may_come_in_one_option_or_several():
    assert chosen("/tf") == ["/tf"]
    assert chosen("/tf,/tf_static", "bare") == ["/tf", "/tf_static", "bare"]


def test_the_leading_slash_is_optional():
    assert chosen("tf", "/bare") == ["/tf", "bare"]


def test_a_name_or_the_expression_is_enough_and_exclusion_wins():
    assert chosen("bare", regex="image") == ["/gmsl/A0/image", "bare"]
    assert chosen("/tf", "/tf_static", exclude="static") == ["/tf"]


def test_an_expression_that_is_none_is_quoted():
    with pytest.raises(ValueError, match=r"^'\(' is no regular expression: missing \)"):
        TopicChoice.of((), "(", None)
