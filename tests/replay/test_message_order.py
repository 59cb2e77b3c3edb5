"""Messages in log-time order, from chunks that overlap and from files that nothing orders."""

from hypothesis import given
from hypothesis import strategies as st

from replay.logged_message import NO_SCHEMA, RawMessage
from replay.message_order import REORDER_NS, in_time_order, reordered

TIMES = st.lists(st.integers(0, 50), max_size=8)


def message(at_ns, number=0):
    return RawMessage("/a", at_ns, NO_SCHEMA, "", b"%d" % number)


@given(st.lists(TIMES.filter(len), max_size=6))
def test_overlapping_chunks_give_what_sorting_everything_gives(chunks):
    made = [[message(at, 100 * i + j) for j, at in enumerate(times)] for i, times in enumerate(chunks)]
    made.sort(key=lambda chunk: min(each.log_time_ns for each in chunk))
    found = list(in_time_order((min(each.log_time_ns for each in chunk), iter(chunk)) for chunk in made))
    assert found == sorted((each for chunk in made for each in chunk), key=lambda each: each.log_time_ns)  # stable


def test_a_chunk_is_read_only_when_its_turn_comes():
    read = []

    def chunk(name, *times):
        read.append(name)
        yield from map(message, times)

    messages = in_time_order([(0, chunk("first", 0, 3)), (5, chunk("second", 5)), (9, chunk("third", 9))])
    assert (next(messages).log_time_ns, next(messages).log_time_ns, read) == (0, 3, ["first"])
    assert (next(messages).log_time_ns, read) == (5, ["first", "second"])


def test_messages_out_of_order_by_less_than_the_window_are_sorted_and_stable():
    late = [message(at, i) for i, at in enumerate([0, REORDER_NS, 5, 5, REORDER_NS + 3, 4])]
    assert [int(each.data) for each in reordered(late)] == [0, 5, 2, 3, 1, 4]


def test_what_is_older_than_the_window_comes_late():
    times = [0, 3 * REORDER_NS, 1]
    assert [each.log_time_ns for each in reordered(map(message, times))] == [0, 1, 3 * REORDER_NS]
    times = [3 * REORDER_NS, 9 * REORDER_NS, 1]
    assert [each.log_time_ns for each in reordered(map(message, times))] == [3 * REORDER_NS, 1, 9 * REORDER_NS]
